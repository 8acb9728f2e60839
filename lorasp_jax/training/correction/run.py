"""Train the correction head of a finished run on the run's own demonstrations."""

from pathlib import Path
from typing import Any

from envs.datasets.episodes import Episodes
from lorasp_jax.data.batches import Steps, flatten
from lorasp_jax.data.cache import Cache
from lorasp_jax.training import dataset, records
from lorasp_jax.training.correction import files
from lorasp_jax.training.correction.fitting import Progress, fit
from lorasp_jax.training.export import load_policy
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run_folder import CONFIG_FILE, read_json

_CONFIG: records.Schema = records.CONFIG | {
    "tasks": [str],
    "data": {"source": str},
    "seed": int,
    "evaluation": {"denoise_steps": int},
}


def train(run: Path, progress: Progress) -> dict[str, float]:
    """Train a head and save it in the run's folder.

    Returns:
        The errors on held-out demonstrations; see `fitting.fit`.

    Raises:
        ValueError: the run is not finished, or its demonstrations are missing or damaged.
    """
    policy = load_policy(run)
    config = read_json(run / CONFIG_FILE, _CONFIG)
    denoise_steps = config["evaluation"]["denoise_steps"]
    key = RandomStream.CORRECTION.key(config["seed"])
    steps = demonstrated(run, config)
    head, error = fit(policy, steps, key, denoise_steps=denoise_steps, progress=progress)
    files.save(run, head, policy, error)
    return error


def demonstrated(run: Path, config: dict[str, Any]) -> Steps:
    """Return the demonstrations that a run was trained on.

    Raises:
        ValueError: they are missing or damaged.
    """
    if source := config["data"]["source"]:
        cached = run / dataset.CACHE
        return Cache(cached if cached.exists() else source).steps
    paths = [run / "cache" / f"{task}.npz" for task in config["tasks"]]
    if missing := [path for path in paths if not path.exists()]:
        raise ValueError(f"{missing[0]} is missing: a correction head needs the demonstrations")
    return flatten([Episodes.load(path) for path in paths])
