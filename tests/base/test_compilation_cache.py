"""Compiled programs are kept in a folder that several processes may share."""

import json
import os
import subprocess
import sys
from pathlib import Path

from tests import ROOT

COMPILE = """
import json

import jax

from lorasp_jax.base import compilation_cache

compilation_cache.enable()
events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event))

def slow(x):
    for i in range(300):
        x = jax.numpy.sin(x @ x) + i
    return x

jax.jit(slow).lower(jax.numpy.ones((8, 8))).compile()
config = jax.config
print(json.dumps([events, config.jax_compilation_cache_dir, config.jax_compilation_cache_max_size]))
"""


def compile_in_process(home, **environment):
    names = ("JAX_COMPILATION_CACHE_DIR", "JAX_COMPILATION_CACHE_MAX_SIZE")
    kept = {name: value for name, value in os.environ.items() if name not in names}
    kept |= {"HOME": str(home), **environment}
    done = subprocess.run(
        [sys.executable, "-c", COMPILE], cwd=ROOT, env=kept, capture_output=True, check=True
    )
    return json.loads(done.stdout)


def test_the_next_process_reads_what_one_compiled(tmp_path):
    """The folder of the first is the next one's user's, who keeps her limit."""
    events, folder, limit = compile_in_process(tmp_path)
    assert "/jax/compilation_cache/cache_misses" in events
    assert Path(folder) == tmp_path / ".cache" / "lorasp_jax" / "jax"
    assert limit > 0, "JAX locks only the files of a limited cache"
    assert list(Path(folder).glob("*-cache"))
    events, mine, limit = compile_in_process(tmp_path, JAX_COMPILATION_CACHE_DIR=folder)
    assert "/jax/compilation_cache/cache_hits" in events
    assert (mine, limit) == (folder, -1)
