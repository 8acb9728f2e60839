"""Save the correction head of a run in its folder, and load it for the same policy.

correction.json names the policy by a digest of its weights and the head's tensors by their SHA-256.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from flax import nnx

from lorasp_jax.base.digest import digest
from lorasp_jax.base.files import as_value_error, read_bytes
from lorasp_jax.base.writing import write_bytes
from lorasp_jax.policies.correction import CorrectionHead
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training import records
from lorasp_jax.training.run_folder import read_json, write_json

TENSORS, DESCRIPTION = "correction.safetensors", "correction.json"
SCHEMA: records.Schema = {
    "policy": str,
    "sha256": str,
    "chunk": int,
    "action_dim": int,
    "cameras": [str],
    "error": {"naive": float, "corrected": float},
}


def save(run: Path, head: CorrectionHead, policy: Policy, error: dict[str, float]) -> None:
    """Write a head into the folder of a run, replacing an earlier one.

    Args:
        run: the run's folder.
        head: the head.
        policy: the policy that the head was trained for.
        error: errors on held-out demonstrations, see `fitting.fit`.
    """
    data = safetensors.numpy.save(
        {name: np.asarray(tensor) for name, tensor in _by_name(nnx.state(head)).items()}
    )
    write_bytes(run / TENSORS, data)
    description = {
        "policy": policy_digest(policy),
        "sha256": hashlib.sha256(data).hexdigest(),
        "chunk": head.chunk,
        "action_dim": head.action_dim,
        "cameras": list(head.cameras),
        "error": error,
    }
    write_json(run / DESCRIPTION, description)


def load(run: Path, policy: Policy) -> CorrectionHead:
    """Load the head of a run.

    Args:
        run: the run's folder.
        policy: the run's policy, as loaded.

    Raises:
        ValueError: there is no head, it is damaged, or it was trained for another policy.
    """
    saved, config = describe(run), policy.model.config
    if (saved["chunk"], saved["action_dim"]) != (config.chunk, config.action_dim):
        raise ValueError(
            f"the correction head in {run} is for chunks of {saved['chunk']} x "
            f"{saved['action_dim']} numbers, but the policy's have {config.chunk} x "
            f"{config.action_dim}: {_remedy(run)}"
        )
    if saved["policy"] != policy_digest(policy):
        raise ValueError(
            f"the correction head in {run} was trained for another policy: {_remedy(run)}"
        )
    with as_value_error(run / TENSORS, remedy=f": {_remedy(run)}"):
        data = read_bytes(run / TENSORS)
        if hashlib.sha256(data).hexdigest() != saved["sha256"]:
            raise ValueError("the checksum does not match")
        return _head(saved, safetensors.numpy.load(data))


def describe(run: Path) -> dict[str, Any]:
    """Return the content of correction.json.

    Raises:
        ValueError: it is missing or damaged.
    """
    path = run / DESCRIPTION
    if not path.exists():
        raise ValueError(f"{run} has no correction head: {_remedy(run)}")
    return read_json(path, SCHEMA)


def _remedy(run: Path) -> str:
    return f"train one with lorasp-jax correction {run}"


def policy_digest(policy: Policy) -> str:
    """Return a digest of a policy's weights, statistics and prompts."""
    return digest(_by_name(policy))


def _head(saved: Mapping[str, Any], tensors: Mapping[str, np.ndarray]) -> CorrectionHead:
    """Build the head that correction.json describes from its tensors."""
    sizes = tuple(saved["cameras"]), saved["action_dim"], saved["chunk"]
    graphdef, state = nnx.split(nnx.eval_shape(lambda: CorrectionHead(*sizes, nnx.Rngs(0))))
    expected = _by_name(state)
    if {k: v.shape for k, v in expected.items()} != {k: v.shape for k, v in tensors.items()}:
        raise ValueError("its tensors are those of another version")
    leaves = [jnp.asarray(tensors[name]) for name in expected]
    return nnx.merge(graphdef, jax.tree.unflatten(jax.tree.structure(state), leaves))


def _by_name(tree: Any) -> dict[str, Any]:
    """Return the leaves of a pytree by "/"-joined path."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}
