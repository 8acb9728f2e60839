"""The best trainable parameters of a run so far, by a callback's measure."""

from pathlib import Path

import jax
from flax import nnx
from safetensors import SafetensorError
from safetensors.flax import load_file, save_file

from lorasp_jax.adapters import adaptation
from lorasp_jax.base.digest import digest
from lorasp_jax.base.files import as_value_error
from lorasp_jax.base.writing import atomic_file
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training import records
from lorasp_jax.training.checkpoint import by_path
from lorasp_jax.training.run_folder import read_json, write_json

BEST, WEIGHTS = "best.json", "best.safetensors"
"""Files of a run: the best step and its error; the trainable parameters of that step."""


def error(folder: Path) -> float:
    """Return the least error so far, infinite if there is none."""
    return read_json(folder / BEST, records.BEST).get("error", float("inf"))


def save(folder: Path, policy: Policy, step: int, error: float) -> None:
    """Replace the best parameters; a crash meanwhile leaves the earlier ones or none."""
    leaves = by_path(adaptation.split(policy.model)[1])
    (folder / BEST).unlink(missing_ok=True)
    with atomic_file(folder / WEIGHTS) as unfinished:
        save_file(leaves, unfinished)
    write_json(folder / BEST, {"step": step, "error": error, "weights": digest(leaves)})


def load(folder: Path, policy: Policy) -> tuple[int, Policy]:
    """Return the best step and `policy` with its trainable parameters.

    Raises:
        ValueError: there is none, or a file is damaged.
    """
    path, best = folder / WEIGHTS, read_json(folder / BEST, records.BEST)
    remedy = f": delete {BEST} and add --resume to keep the last adapters"
    with as_value_error(path, SafetensorError, remedy=remedy):
        leaves = load_file(path)
        if not best or digest(leaves) != best["weights"]:
            raise ValueError(f"it does not match {BEST}")
    graphdef, adapters, frozen = adaptation.split(policy.model)
    old = by_path(adapters)
    placed = [jax.device_put(leaves[path], leaf.sharding) for path, leaf in old.items()]
    adapters = jax.tree.unflatten(jax.tree.structure(adapters), placed)
    return best["step"], Policy(nnx.merge(graphdef, adapters, frozen), policy.processor)
