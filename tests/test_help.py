"""What `--help` prints needs nothing that is slow to import or to start."""

import os
import re
import subprocess
import sys

import pytest

from tests import ROOT

SLOW = (
    "av",
    "envs.physics.physics",
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


def assert_light(found):
    assert re.search(r"^slow:$", found.stdout, re.MULTILINE), found.stdout.splitlines()[-1]


def run(arguments):
    program = PROGRAM.format(slow=SLOW, arguments=arguments)
    return subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_light(name):
    arguments, option = COMMANDS[name]
    found = run(arguments)
    assert found.returncode == 0, found.stderr
    assert option in found.stdout
    assert_light(found)


@pytest.mark.parametrize("option", ["--tasks", "--robot"])
def test_an_unknown_name_is_refused_before_slow_imports(option):
    parse = "from lorasp_jax.training.overrides import parse; parse"
    named = f"['--config', 'configs/multitask.py', '--scale', 'smoke', '{option}', 'juggle']"
    program = PROGRAM.partition("sys.argv")[0].format(slow=SLOW)
    found = subprocess.run(
        [sys.executable, "-c", f"{program}\n{parse}({named})"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert "'juggle': choose from" in found.stderr
    assert_light(found)


@pytest.mark.parametrize(
    "arguments", [["train.py"], ["-m", "envs"], ["-m", "lorasp_jax.data"]], ids=str
)
def test_a_reader_that_leaves_is_told_nothing(arguments):
    reading, writing = os.pipe()
    os.close(reading)
    found = subprocess.run(
        [sys.executable, *arguments, "--help"],
        cwd=ROOT,
        env={name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"},
        stdout=writing,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    os.close(writing)
    assert (found.returncode, found.stderr) == (141, "")
