"""Replay of what the base was taught, so that it is not forgotten."""

import dataclasses

from lorasp_jax.base import hub
from lorasp_jax.config import Config
from lorasp_jax.training import records
from lorasp_jax.training.base import TRAINING
from lorasp_jax.training.run_folder import read_json


def replayed_tasks(config: Config) -> tuple[str, ...]:
    """Return the tasks to replay: those that the base was taught and the run does not train on.

    Raises:
        ValueError: there are none, or the base was taught another robot or on recordings.
    """
    if not config.data.replay or config.data.source:
        return ()
    where = config.model.source
    taught = read_json(hub.local(where) / TRAINING, records.TAUGHT) if where else {}
    if not taught:
        raise ValueError(
            f"data.replay needs to know what the base {where or '(random)'} was taught, but its "
            "files do not say: train on datasets with --data.source, and name that of the base last"
        )
    if taught["robot"] != config.robot or not taught["physics_dt"]:
        by = taught["robot"] if taught["physics_dt"] else f"recordings of {taught['robot']}"
        raise ValueError(
            f"{where} was taught {', '.join(taught['tasks'])} by {by}, not by {config.robot} in "
            "simulation, which data.replay needs without data.source"
        )
    if not (others := tuple(task for task in taught["tasks"] if task not in config.tasks)):
        raise ValueError(f"{where} was taught no other tasks than this run's: drop data.replay")
    return others


def with_replayed(config: Config) -> Config:
    """Return the config of collecting a run's demonstrations: its tasks, then those to replay."""
    return dataclasses.replace(config, tasks=(*config.tasks, *replayed_tasks(config)))
