"""Test of studies/warp_ahead.py, in a process of its own since it replaces Warp's launches."""

import os
import subprocess
import sys

import pytest

from tests import ROOT

CODE = """
import warp as wp
from studies import warp_ahead

wp.init()
modules = warp_ahead.record()
warp_ahead.play("press", None, 0)
small = next(m for m in modules if "solve_init_jaref" in m[0].name)
warp_ahead.build(*small, 90)
assert len(modules) > 30, len(modules)
assert any(block not in (1, 256) for _, block in modules), "tiled kernels as on a CPU"
"""


@pytest.mark.slow
def test_kernels_are_compiled_for_a_gpu_that_is_not_there(tmp_path):
    pytest.importorskip("warp")
    env = {**os.environ, "WARP_CACHE_PATH": str(tmp_path), "JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", CODE], cwd=ROOT, env=env, check=True)
    (binary,) = tmp_path.rglob("*.sm90.cubin")
    assert binary.read_bytes()[:4] == b"\x7fELF"
    assert list(binary.parent.glob("*.meta"))
