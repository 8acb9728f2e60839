"""Demonstrations that cells share: those to train on, and held-out ones that no cell trains on."""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import jax

from envs.datasets.episodes import Episodes
from lorasp_jax.base.locks import locked
from lorasp_jax.config import Config
from lorasp_jax.data.batches import Batch, flatten, sample_batch
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.demonstrations import Progress, demonstrations, map_threads

EPISODES = 32
"""Held-out episodes per task."""
SEED = 2**32 - 1
"""Seed of the held-out episodes; no cell may have it."""

Sample = Callable[[jax.Array], Batch]
"""Returns the batch of a random key."""
Keyed = tuple[jax.Array, Batch]
"""A batch with the key of its loss."""

_SIZES = ("batch_size", "chunk", "state_noise")
_sample = jax.jit(sample_batch, static_argnames=_SIZES)  # seeds share its programs


def shared_demonstrations(
    study_folder: Path, config: Config, _folder: Path, progress: Progress
) -> dict[str, Episodes]:
    """Load the demonstrations that cells with the same robot, scene and data settings share.

    They do not depend on the seed, and a task has the same ones whatever tasks it is trained with.
    The first cell that needs them collects them.
    """
    shared = dataclasses.replace(config, seed=0)
    return _shared(study_folder / "demonstrations", shared, progress)


def held_out_demonstrations(study_folder: Path, config: Config) -> dict[str, Episodes]:
    """Load the held-out demonstrations (see `settings`), shared in the same way."""
    return _shared(study_folder / "held_out", settings(config))


def settings(config: Config) -> Config:
    """Return the config whose demonstrations are the held-out episodes of a run.

    Raises:
        ValueError: the run has the seed of the held-out episodes.
    """
    if config.seed == SEED:
        raise ValueError(f"seed {SEED} is reserved for held-out episodes")
    data = dataclasses.replace(config.data, source="", fresh_every=0, episodes=EPISODES)
    return dataclasses.replace(config, data=data, seed=SEED)


def sampler(policy: Policy, episodes: Episodes, batch_size: int) -> Sample:
    """Return a function from a key to a batch of windows that start at random steps of `episodes`.

    Unlike in training, the state has no noise.

    Raises:
        ValueError: the policy has no prompt for one of the instructions.
    """
    rows, steps = policy.processor.prompts.rows(episodes.instructions), flatten([episodes])
    steps = jax.device_put(dataclasses.replace(steps, instruction=rows[steps.instruction]))
    sizes = {"batch_size": batch_size, "chunk": policy.model.config.chunk, "state_noise": 0.0}
    return lambda key: _sample(key, steps, policy.processor, **sizes)


def keyed_batches(
    policy: Policy, episodes: Mapping[str, Episodes], batch_size: int, batches: int
) -> dict[str, list[Keyed]]:
    """Return a fixed number of batches by task, each with a key for the noise of its loss.

    All tasks have the same keys.
    """
    keys = jax.random.split(jax.random.key(0), (batches, 2))
    found = {}
    for task, group in episodes.items():
        sample = sampler(policy, group, batch_size)
        found[task] = [(loss_key, sample(batch_key)) for batch_key, loss_key in keys]
    return found


def forward(model: Any, keyed: Keyed) -> Any:
    """Return the model's loss per action element and its auxiliary values on a batch."""
    key, batch = keyed
    return model.loss(key, batch.observation, batch.actions, action_mask=batch.action_mask)


def _shared(
    root: Path, config: Config, progress: Progress = lambda *_: None
) -> dict[str, Episodes]:
    """Load each task's episodes from a folder named after the settings, or collect them there."""
    settings = {
        "robot": config.robot,
        "data": dataclasses.asdict(config.data),
        "image_size": config.image_size,
        "control_dt": config.control_dt,
    }
    if ranges := config.scene.changed():
        settings["scene"] = ranges
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]
    folder = root / f"{Path(config.robot).stem}_{digest}"

    def one(task: str) -> Episodes:
        single = dataclasses.replace(config, tasks=(task,))
        file = folder / "cache" / f"{task}.npz"
        alone = nullcontext() if file.exists() else locked(file, waiting=lambda: None)
        with alone:  # one process at a time makes a file; nobody waits once it exists
            return demonstrations(single, folder, progress)[task]

    return dict(zip(config.tasks, map_threads(one, config.tasks), strict=True))
