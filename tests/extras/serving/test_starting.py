"""Test what makes a server's second start quick: programs that are kept, and few imports."""

import os
import subprocess
import sys

import jax
import pytest

from tests import ROOT
from tests.extras.serving.test_policies import compiled, make_policy


def test_servers_of_different_seeds_run_the_same_programs():
    """If a seed were a constant of a program, every start would compile it."""
    policies = [compiled({"base": make_policy()}, seed=seed) for seed in (1, 2)]
    index = jax.ShapeDtypeStruct((1, 2), "int32")
    first, second = (each._draw.lower(each._key, index, (4, 7)).as_text() for each in policies)
    assert first == second


def test_a_server_does_not_import_what_only_training_needs():
    code = """if True:
        import sys
        from lorasp_jax.extras.serving import __main__, loading, served, server
        print(*{name.partition(".")[0] for name in sys.modules})
    """
    words = [sys.executable, "-c", code]
    found = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert not {"torch", "tensorboardX", "matplotlib", "mujoco", "grain"} & {*found.split()}


@pytest.mark.slow
def test_a_second_start_compiles_nothing_that_takes_long(tmp_path):
    """Each start draws a seed of its own."""
    words = [sys.executable, "-m", "lorasp_jax.extras.serving", "assets/pi0_nano", "--joints", "7"]
    words += ["--port", "0", "--max-batch", "1", "--denoise-steps", "1"]
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
    kept = []
    for _ in range(2):
        pipes = {"stdout": subprocess.PIPE, "text": True, "cwd": ROOT, "env": environment}
        with subprocess.Popen(words, **pipes) as server:
            assert any(line.startswith("listening") for line in server.stdout)
            server.terminate()
        kept.append({path.name for path in tmp_path.glob("*-cache")})
    assert len(kept[0]) >= 2  # the sampler and the noise
    assert kept[0] == kept[1]
