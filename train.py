"""Adapt a policy to a robot: `python train.py --config configs/multitask.py`."""

import sys

from lorasp_jax.cli import commands

if __name__ == "__main__":
    commands.exit_on_signals()
    commands.run("train", sys.argv[1:], "python train.py")
