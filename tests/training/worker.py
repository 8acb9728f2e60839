"""A process that trains until it is stopped: python -m tests.training.worker FOLDER."""

import argparse
import dataclasses
import itertools
import os
import signal
from pathlib import Path

from tests import xla


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--until", type=int, help="step at which to raise a signal")
    parser.add_argument("--fails", type=int, help="step at which to raise an uncaught error")
    parser.add_argument("--hangs", type=int, help="number of steps until it waits to be killed")
    parser.add_argument("--devices", type=int, default=8, help="number of devices")
    parser.add_argument("--mesh", type=int, help="number of devices to use; default: all")
    return parser.parse_args()


def main(args: argparse.Namespace) -> None:
    os.environ["JAX_PLATFORMS"] = "cpu"
    os.environ["XLA_FLAGS"] = xla.flags(args.devices)
    import jax
    from rich.console import Console

    from lorasp_jax.base import compilation_cache as cache

    cache.enable()
    xla.drop_training_step_options()
    jax.config.update("jax_default_matmul_precision", "highest")
    from lorasp_jax.training.distributed import processes

    if "JAX_PROCESS_ID" in os.environ:
        processes.initialize(Console())

    work(args.folder, args.steps, args.until, args.fails, args.mesh, args.hangs)


def prepare(folder: Path, steps: int, devices: int | None = None):
    """Return a run that logs and saves at every step."""
    from lorasp_jax.peft import LoRA
    from tests.runs import CONFIG, PROGRAMS, Miniature, make_run

    # Two processes have 16 devices, and a batch is a multiple of that.
    config = dataclasses.replace(
        CONFIG,
        peft=LoRA(rank=4),  # compiles faster than others
        optim=dataclasses.replace(CONFIG.optim, steps=steps, batch_size=16),
        targets=("inp", "out"),
        log_every=1,
        checkpoint_every=1,
    )
    run = make_run(folder, config, Miniature(), devices)
    run.programs = PROGRAMS
    return run


def work(
    folder: Path,
    steps: int,
    until: int | None = None,
    fails: int | None = None,
    devices: int | None = None,
    hangs: int | None = None,
):
    """Start or resume the run; return it if it finishes."""
    from lorasp_jax.training.interrupt import sigterm_as_interrupt
    from lorasp_jax.training.loop import train
    from lorasp_jax.training.run import Callback

    count = itertools.count(1)

    class PrintStep(Callback):
        def on_log(self, run, step, metrics):
            print("step", step, flush=True)
            if step == fails:
                raise RuntimeError("nobody catches this")
            if next(count) == hangs:
                signal.pause()
            if step == until:
                signal.raise_signal(signal.SIGTERM)

    with sigterm_as_interrupt():
        run = prepare(folder, steps, devices)
        print("started", flush=True)
        try:
            train(run, [PrintStep()], resume=True)
        except KeyboardInterrupt:
            print("stopped", flush=True)
            return None
    print("finished", flush=True)
    return run


if __name__ == "__main__":
    main(arguments())
