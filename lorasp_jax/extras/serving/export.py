"""Export policies: `python -m lorasp_jax.extras.serving.export runs/NAME --out FOLDER`."""

import argparse
import functools
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from lorasp_jax.base.arguments import NAME, named, positive
from lorasp_jax.base.errors import run_command


def main(
    arguments: Sequence[str], program: str = "python -m lorasp_jax.extras.serving.export"
) -> int:
    """Export runs; return the exit code, one of `lorasp_jax.base.errors`."""
    options = parser(program).parse_args(arguments)
    return run_command(lambda: _export(options, Console()))


def parser(program: str) -> argparse.ArgumentParser:
    """Return the argument parser of this command."""
    parser = argparse.ArgumentParser(
        prog=program,
        description="Export the policies of finished runs as a folder that runs without this "
        "package. See docs/serving.md.",
    )
    add = parser.add_argument
    add("run", nargs="+", type=named, metavar="[NAME=]RUN", help="folder of a finished run. "
        "Of several runs, the base is stored once, and the first is the default")  # fmt: skip
    add("--out", type=Path, required=True, metavar="FOLDER", help="folder to create")
    add("--base", default="", help="the run's base, if it has moved")
    add("--tokenizer", default="", help="the policy's tokenizer, if it has moved")
    add("--dataset", default="", help="for which of the run's datasets, if they differ")
    text = "flow steps (default: as in the run's evaluation)"
    add("--denoise-steps", type=positive, metavar="N", help=text)
    add("--max-batch", type=int, default=8, help="largest batch (default: %(default)s)")
    return parser


def _export(options: argparse.Namespace, console: Console) -> None:
    import jax

    runs = dict(options.run)
    named = len(runs) == 1 or all(map(NAME.fullmatch, runs))
    if len(runs) < len(options.run) or not named:
        raise ValueError(f"the runs must have different names that match {NAME.pattern}: NAME=RUN")
    if options.out.exists():  # said before the run loads, which can take a minute
        raise ValueError(f"{options.out} already exists: choose another path")
    jax.config.update("jax_platforms", "cpu")
    from lorasp_jax.extras.serving import exporting, loading
    from lorasp_jax.extras.serving.adapters import Bases

    where = {"base": options.base, "words": options.tokenizer, "dataset": options.dataset}
    steps, settings = options.denoise_steps, {"max_batch": options.max_batch}
    if len(runs) == 1:
        loaded = loading.load_run(*runs.values(), **where)
        settings |= {"continues": bool(loaded.continues), "metadata": loaded.metadata}
        settings |= {"num_steps": steps or loaded.denoise_steps}
        exporting.write(loaded.policy, options.out, **settings)
    else:
        bases, policies = Bases(), {}
        for name, run in runs.items():
            model = functools.partial(bases.sampler, load=not policies)
            policies[name] = loading.load_run(run, **where, model=model)
        exporting.write_bundle(policies, options.out, num_steps=steps, **settings)
    megabytes = sum(file.stat().st_size for file in options.out.rglob("*")) / 1e6
    console.print(f"wrote {options.out}, {megabytes:.1f} MB", soft_wrap=True, highlight=False)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
