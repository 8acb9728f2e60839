"""Test that `--help` does not import slow packages or start a JAX backend."""

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
    "deploy": (["-m", "lorasp_jax.extras.deployment", "--help"], "--save"),
    "report": (["-m", "lorasp_jax.report", "--help"], "rank-map"),
    "export": (["-m", "lorasp_jax.extras.serving.export", "--help"], "--max-batch"),
    "rank maps": (["-m", "lorasp_jax.report", "rank-map", "--help"], "--task"),
}
PROGRAM = """
import atexit, runpy, sys

def report():
    from jax._src import xla_bridge
    started = ["a JAX backend"] if xla_bridge.backends_are_initialized() else []
    print("slow:", *[name for name in {slow} if name in sys.modules], *started)

atexit.register(report)
sys.argv = {arguments}
if sys.argv[0] == "-m":
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
else:
    runpy.run_path(sys.argv[0], run_name="__main__")
"""


def assert_nothing_slow(process):
    assert re.search(r"^slow:$", process.stdout, re.MULTILINE), process.stdout.splitlines()[-1]


def run(arguments):
    program = PROGRAM.format(slow=SLOW, arguments=arguments)
    return subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_fast(name):
    arguments, option = COMMANDS[name]
    process = run(arguments)
    assert process.returncode == 0, process.stderr
    assert option in process.stdout
    assert_nothing_slow(process)


@pytest.mark.parametrize("option", ["--tasks", "--robot"])
def test_unknown_name_fails_before_slow_imports(option):
    parse = "from lorasp_jax.training.overrides import parse; parse"
    arguments = f"['--config', 'configs/multitask.py', '--scale', 'smoke', '{option}', 'juggle']"
    program = PROGRAM.partition("sys.argv")[0].format(slow=SLOW)
    process = subprocess.run(
        [sys.executable, "-c", f"{program}\n{parse}({arguments})"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert "'juggle': choose from" in process.stderr
    assert_nothing_slow(process)
