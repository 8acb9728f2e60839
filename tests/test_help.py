"""What `--help` prints needs nothing that is slow to import or to start."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SLOW = (
    "av",
    "envs.physics",
    "grain",
    "matplotlib",
    "mujoco",
    "orbax",
    "pyarrow",
    "scipy",
    "tensorflow_datasets",
    "trimesh",
    "warp",
)
COMMANDS = {
    "train": (["train.py", "--help"], "--optim.learning-rate"),
    "train a config": (["train.py", "--config", "configs/multitask.py", "--help"], "--peft.rank"),
    "data": (["-m", "lorasp_jax.data", "--help"], "inspect"),
    "data inspect": (["-m", "lorasp_jax.data", "inspect", "--help"], "--state-numbers"),
}
PROGRAM = """
import atexit, runpy, sys

def tell():
    from jax._src import xla_bridge
    started = ["a JAX backend"] if xla_bridge.backends_are_initialized() else []
    print("slow:", *[name for name in {slow} if name in sys.modules], *started)

atexit.register(tell)
sys.argv = {arguments}
if sys.argv[0] == "-m":
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
else:
    runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_light(name):
    arguments, option = COMMANDS[name]
    program = PROGRAM.format(slow=SLOW, arguments=arguments)
    found = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert found.returncode == 0, found.stderr
    assert option in found.stdout
    assert re.search(r"^slow:$", found.stdout, re.MULTILINE), found.stdout.splitlines()[-1]
