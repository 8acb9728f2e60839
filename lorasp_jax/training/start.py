"""Start from a finished run: what it decides, and the export of the later one."""

import dataclasses
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console

from lorasp_jax.adapters.io import native
from lorasp_jax.config import Config
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.noise_actor import PATH
from lorasp_jax.training import dataset, export
from lorasp_jax.training.demonstrations import Demonstrations
from lorasp_jax.training.export import BASE, describe
from lorasp_jax.training.replay import with_replayed
from lorasp_jax.training.run import Run

C = TypeVar("C", bound=Config)
KEPT = ("model", "robot", "image_size", "scene", "control_dt", "data")
"""Fields of the config that a start run decides."""
ADAPTERS = ("peft", "targets", "adapt", "plan")
"""Fields that it decides if its adapters are trained further."""


def with_kept(
    config: C, start: Path, recorded: Config, names: Sequence[str], given: Collection[str]
) -> C:
    """Return the config with the named fields of the start run's.

    Args:
        config: as parsed.
        start: folder of the start run.
        recorded: its config.
        names: of the fields that it decides.
        given: names of the fields that the user set.

    Raises:
        ValueError: a field that the start run decides was given, it trained its base or an actor of
            its noise, or it was trained on several datasets that have statistics or cameras of
            their own.
    """
    for name in names:
        values = getattr(config, name), getattr(recorded, name)
        own = sorted(field for field in given if field.partition(".")[0] == name)
        if own and values[0] != values[1]:
            what = f" ({values[1]})" if isinstance(values[1], str) else ""
            option = "method" if own[0] == "peft" else own[0].replace("_", "-")
            raise ValueError(f"--{option} is that of {start}{what}: drop it")
    if (start / BASE).is_dir():
        raise ValueError(f"{start} has no adapters, it trained its base: start from another run")
    refuse_actor(start, "start from the run that it started from")
    if len(found := export.datasets(describe(start))) > 1:
        raise ValueError(
            f"{start} has statistics or cameras for each of {', '.join(found)}: start from a run "
            "with one dataset"
        )
    return dataclasses.replace(config, **{name: getattr(recorded, name) for name in names})


def refuse_actor(run: Path, remedy: str) -> None:
    """Raise ValueError if the policy of a run has an actor that chooses its noise."""
    if PATH in describe(run):
        raise ValueError(f"the policy of {run} has learned its initial noise: {remedy}")


def with_data(
    config: Config, folder: Path, model: BackboneConfig, collect: Callable[..., Demonstrations]
) -> Run:
    """Return a finished run with its data; a dataset stays on the disk.

    `collect` loads or collects its demonstrations.

    Raises:
        ValueError: its recordings are gone, or are others.
    """
    run = Run(config, folder, Console(quiet=True), base_hash="")
    if config.data.source:
        try:
            dataset.load(run, dataset.open_dataset(config, model, folder), free_bytes=0.0)
        except ValueError as error:
            raise ValueError(f"the recordings of {folder} cannot be read: {error}") from error
        return run
    run.episodes = collect(with_replayed(config), folder, lambda *_: None)
    return run


def write(run: Run, start: Path, **changes: Any) -> None:
    """Export a policy that started from a run's, as `export.write` does.

    `changes` are entries that differ from those of the start run's adapter.json.
    """
    metadata = describe(start) | changes
    native.save_adapters(run.folder, run.policy.model, base=run.base_hash, metadata=metadata)
