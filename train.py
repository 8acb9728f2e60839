"""Adapt a policy to a robot: `python train.py --config configs/multitask.py`."""

import os
import signal
import sys

if __name__ == "__main__":
    for _number in (signal.SIGINT, signal.SIGTERM):  # while the rest is imported: nothing to save
        signal.signal(_number, lambda *_: os._exit(130))
    from lorasp_jax.cli import commands

    commands.run("train", sys.argv[1:], "python train.py")
