"""Test that `--help` does not import slow packages or start a JAX backend."""

import re
import subprocess
import sys

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
MULTITASK = ["--config", "configs/multitask.py", "--scale", "smoke"]
COMMANDS = [
    (["train.py", "--help"], "--optim.learning-rate"),
    (["train.py", "--config", "configs/multitask.py", "--help"], "--peft.rank"),
    (["-m", "lorasp_jax.data", "--help"], "inspect"),
    (["-m", "lorasp_jax.data", "inspect", "--help"], "--state-numbers"),
    (["-m", "lorasp_jax.extras.deployment", "--help"], "--save"),
    (["-m", "lorasp_jax.report", "--help"], "rank-map"),
    (["-m", "lorasp_jax.extras.serving.export", "--help"], "--max-batch"),
    (["-m", "lorasp_jax.report", "rank-map", "--help"], "--task"),
    (["train.py", *MULTITASK, "--tasks", "juggle"], "unknown task 'juggle': choose from"),
    (["train.py", *MULTITASK, "--robot", "juggle"], "unknown robot 'juggle': choose from"),
]
PROGRAM = """
import os, runpy, sys
from jax._src import xla_bridge
from lorasp_jax.cli import train

def leave(code):
    raise SystemExit(code)

os._exit = leave
for arguments in {commands}:
    print("command:", *arguments)
    sys.argv = arguments[arguments[0] == "-m" :]
    try:
        if arguments[0] == "-m":
            runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
        else:
            runpy.run_path(sys.argv[0], run_name="__main__")
    except SystemExit as exit:
        print("exit code:", exit.code)
    started = ["a JAX backend"] if xla_bridge.backends_are_initialized() else []
    print("slow:", *[name for name in {slow} if name in sys.modules], *started)
"""


def test_help_and_unknown_names_are_fast():
    """In one process, whose modules add up."""
    program = PROGRAM.format(slow=SLOW, commands=[arguments for arguments, _ in COMMANDS])
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    _, *parts = re.split("^command: ", done.stdout, flags=re.MULTILINE)
    assert len(parts) == len(COMMANDS), done.stdout
    for part, (arguments, expected) in zip(parts, COMMANDS, strict=True):
        assert expected in part, arguments
        assert f"exit code: {0 if '--help' in arguments else 2}\n" in part, arguments
        assert re.search(r"^slow:$", part, re.MULTILINE), part.splitlines()[-1]
