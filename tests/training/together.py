"""One of several processes of a run, see test_processes.py.

python -m tests.training.together FOLDER STREAMS
"""

import contextlib
import dataclasses
import functools
import os
import sys
from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from lorasp_jax.config import EvaluationConfig
from lorasp_jax.data.batches import flatten
from lorasp_jax.peft import FullFineTuning
from lorasp_jax.training.distributed import mesh, processes
from lorasp_jax.training.loop import train
from lorasp_jax.training.run import Callback, Run
from tests.runs import CONFIG, Terminate, make_run


class CheckPolicy(Callback):
    """Checks that the policy is on devices of its own process, as evaluation needs it."""

    def on_start(self, run):
        assert all(x.is_fully_addressable for x in jax.tree.leaves(run.policy))

    def on_log(self, run, step, metrics):
        assert run.config.evaluates(step) == (step == 2)
        if step == 2:
            self.on_start(run)

    def on_end(self, run):
        self.on_start(run)
        assert processes.is_first()
        (run.folder / "ended").touch()


def main(folder: str, streams: str) -> None:
    """Run until a signal, then resume; arrays over 1 KiB are sharded."""
    if "JAX_PROCESS_ID" in os.environ:
        processes.initialize(Console())
    mesh.shardings = functools.partial(mesh.shardings, minimum=1024)
    config = dataclasses.replace(
        CONFIG,
        peft=FullFineTuning(),
        targets=("action_out_proj", "fc1"),
        fsdp=2,
        evaluation=EvaluationConfig(every=2),
    )
    first = processes.is_first()

    def new_run() -> Run:
        run = make_run(Path(folder), config, devices=None)
        if streams == "True":
            steps = flatten([*run.episodes.values()])
            run.dataset, run.streams = jax.tree.map(np.asarray, steps), True
        return run

    with contextlib.suppress(KeyboardInterrupt):
        train(new_run(), [CheckPolicy(), Terminate()] if first else [])  # signals only one process
        raise AssertionError("not stopped")
    train(new_run(), [CheckPolicy()] if first else [], resume=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
