"""Measure a finished run on the episodes of its own datasets that its training held out."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from lorasp_jax.data.source import Source
from lorasp_jax.evaluation.held_out import HeldOut, measure, windows
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training import export, finished_run, records, start
from lorasp_jax.training.demonstrations import demonstrations
from lorasp_jax.training.run_folder import DATASET_FILE, read_json


class Subject(NamedTuple):
    """A policy, and the episodes of a dataset, by number, on which it is measured."""

    policy: Policy
    source: Source
    episodes: Sequence[int]


def measure_held_out(
    run: str | os.PathLike[str], *, dataset: str = "", num_steps: int | None = None
) -> dict[str, HeldOut]:
    """Measure a finished run on exactly the episodes that its training held out.

    Args:
        run: folder of the run.
        dataset: name of one of its datasets; "": all.
        num_steps: Euler steps of the flow-matching sampler; None: those of the run's evaluation.

    Returns:
        The measurements of each dataset by name, of the policy that acts for it.

    Raises:
        ValueError: see `subjects`.
    """
    found, steps = subjects(Path(run), dataset), num_steps or export.denoise_steps(run)
    return {
        name: measure(policy, windows(source, episodes, policy), num_steps=steps)
        for name, (policy, source, episodes) in found.items()
    }


def subjects(run: Path, dataset: str = "") -> dict[str, Subject]:
    """Return what `measure_held_out` measures; reads the datasets again if their cache is gone.

    Raises:
        ValueError: the run is not finished, held nothing out, or nothing of the named dataset; or
            its recordings are gone, or are others.
    """
    own = export.datasets(export.describe(run))
    recorded = read_json(run / DATASET_FILE, records.DATASET)
    if not recorded or "held_out" not in recorded["facts"]:
        raise ValueError(
            f"{run} has no episodes that training held out: name recordings with --data"
        )
    config = finished_run.recorded_config(run, simulated=False)
    data = start.with_data(config, run, export.RecordedPolicy.read(run).config, demonstrations)
    cache = data.recordings
    assert cache is not None
    names = [part.name for part in cache.parts]
    if not names[1:]:  # that of the dataset, not of its cache
        names = [Path(config.data.source[0]).name.removesuffix(".toml")]
    held: dict[str, list[int]] = {}
    for number in data.held_out:
        held.setdefault(names[cache.dataset[number]], []).append(number)
    if dataset and dataset not in held:
        raise ValueError(f"{run} held out episodes of {', '.join(held)}, none of {dataset!r}")
    policy = export.load_policy(run)

    def acting_for(name: str) -> Policy:
        if name not in own:
            return policy
        processor = export.RecordedPolicy.read(run, dataset=name).processor()
        return dataclasses.replace(policy, processor=processor)

    chosen = [dataset] if dataset else held
    return {name: Subject(acting_for(name), cache, held[name]) for name in chosen}
