"""Write a policy as a folder that runs without this package; `exported` describes it and reads it.

The programs are traced for the CPU, whose operations run on every platform: unlike in training,
they contain none of this project's GPU kernels.
"""

import contextlib
import dataclasses
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from jax import export

import lorasp_jax
from lorasp_jax.base.locks import locked
from lorasp_jax.base.writing import atomic_folder
from lorasp_jax.extras.serving import exported
from lorasp_jax.extras.serving.exported import Description
from lorasp_jax.extras.serving.policies import batch_sizes, describe, sample, without_prompts
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.statistics import Statistics


def write(
    policy: Policy,
    folder: str | os.PathLike[str],
    *,
    continues: bool = False,
    num_steps: int = 10,
    max_batch: int = 8,
    metadata: Mapping[str, Any] | None = None,
) -> None:
    """Export a policy.

    Args:
        policy: with any base, for example a quantized one, and with any adapters or none.
        folder: to be created, completely or not at all.
        continues: whether the policy was trained to continue chunks; see docs/latency.md.
        num_steps: Euler steps of the flow-matching sampler.
        max_batch: largest batch; see `batch_sizes`.
        metadata: JSON values for the clients of a server.

    Raises:
        ValueError: the folder exists, the policy has no instructions, a number is less than 1, or
            JAX uses another platform than the CPU.
    """
    folder = Path(folder)
    if jax.default_backend() != "cpu":
        raise ValueError("policies are exported on the CPU: set JAX_PLATFORMS=cpu")
    if not policy.processor.prompts.instructions:
        raise ValueError("a policy without instructions cannot be exported")
    if num_steps < 1:
        raise ValueError(f"the number of flow steps must be at least 1, got {num_steps}")
    description = describe(
        policy,
        num_steps=num_steps,
        batch_sizes=batch_sizes(max_batch),
        continues=continues,
        metadata=metadata or {},
    )
    with locked(folder), atomic_folder(folder) as unfinished:
        _write_json(unfinished / exported.INSTRUCTIONS, _tokens(policy))
        _write_json(unfinished / exported.PROCESSOR, _normalization(policy))
        programs, weights = _export(without_prompts(policy), description)
        (unfinished / exported.WEIGHTS).write_bytes(safetensors.numpy.save(weights))
        for each, program in programs.items():
            (unfinished / exported.program_file(*each)).write_bytes(program.serialize())
        _write_json(unfinished / exported.DESCRIPTION, _contents(unfinished, description))


def _tokens(policy: Policy) -> dict[str, Any]:
    """Return the tokens of each instruction as JSON values."""
    prompts = policy.processor.prompts
    ids, mask = (np.asarray(array).tolist() for array in prompts.start)
    rows = zip(prompts.instructions, ids, mask, strict=True)
    return {text: {"ids": ids, "mask": mask} for text, ids, mask in rows}


def _normalization(policy: Policy) -> dict[str, Any]:
    """Return what processor.json contains: statistics by slot, the action's slots, conventions."""
    processor = policy.processor
    statistics = jax.tree.map(lambda a: np.asarray(a).tolist(), _by_kind(processor.statistics))
    inputs = dataclasses.asdict(processor.inputs)
    return {"statistics": statistics, "slots": processor.action_slots, "inputs": inputs}


def _by_kind(statistics: Statistics) -> dict[str, dict[str, jax.Array]]:
    return {"state": dict(statistics.state), "action": dict(statistics.action)}


def _contents(folder: Path, description: Description) -> dict[str, Any]:
    """Return what policy.json contains."""
    values = {
        "format": exported.FORMAT,
        "lorasp_jax": lorasp_jax.__version__,
        "jax": jax.__version_info__,
        "platforms": exported.PLATFORMS,
        "policy": dataclasses.asdict(description),
        "files": {name: exported.file_digest(folder / name) for name in description.files},
    }
    return {**values, "digest": exported.digest(values)}


def _export(
    policy: Policy, description: Description
) -> tuple[dict[tuple[str, int], export.Exported], dict[str, np.ndarray]]:
    """Export all programs, and name the weights that they take."""
    statistics = _by_kind(policy.processor.statistics)
    tokens = policy.processor.prompts.start.ids.shape[1]
    bare = dataclasses.replace(policy.processor, statistics=None)
    leaves, tree = jax.tree.flatten(dataclasses.replace(policy, processor=bare))

    def act(weights: list[jax.Array], statistics: Any, inputs: dict[str, Any]) -> jax.Array:
        policy = jax.tree.unflatten(tree, weights)
        processor = dataclasses.replace(policy.processor, statistics=Statistics(**statistics))
        policy = dataclasses.replace(policy, processor=processor)
        return sample(policy, inputs, num_steps=description.num_steps)

    with _without_paths():
        inputs = {each: _inputs(description, tokens, *each) for each in description.programs}
        full = {each: _trace(act, leaves, statistics, i) for each, i in inputs.items()}
        used = sorted(set().union(*(p.module_kept_var_idx for p in full.values())))
        used = [i for i in used if i < len(leaves)]  # the first arguments are the weights
        weights = [leaves[i] for i in used]
        programs = {
            each: _trace(_with_weights(full[each], leaves, used), weights, statistics, i)
            for each, i in inputs.items()
        }
    return programs, {f"{i:06}": np.asarray(array) for i, array in enumerate(weights)}


def _trace(function: Callable[..., Any], *arguments: Any) -> export.Exported:
    return export.export(jax.jit(function), platforms=exported.PLATFORMS)(*arguments)


def _with_weights(
    program: export.Exported, leaves: Sequence[jax.Array], used: Sequence[int]
) -> Callable[..., jax.Array]:
    """Return the program as a function of only the weights in use.

    A sampler has more, since it consists of two copies of the backbone that each use a part.
    """

    def act(weights: list[jax.Array], *others: Any) -> jax.Array:
        given = dict(zip(used, weights, strict=True))
        full = [given.get(i, jnp.zeros(a.shape, a.dtype)) for i, a in enumerate(leaves)]
        return program.call(full, *others)

    return act


def _inputs(description: Description, tokens: int, kind: str, batch: int) -> dict[str, Any]:
    """Return the shapes of the inputs of `ExportedPolicy.run`."""
    size, chunk = description.image_size, description.chunk

    def each(dtype: Any, *shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((batch, *shape), dtype)

    inputs = {
        "images": dict.fromkeys(description.cameras, each(np.uint8, size, size, 3)),
        "present": dict.fromkeys(description.cameras, each(np.bool_)),
        "state": each(np.float32, description.state_dim),
        "noise": each(np.float32, chunk, description.action_dim),
        "ids": each(np.int32, tokens),
        "mask": each(np.bool_, tokens),
    }
    if kind == exported.CONTINUE:
        previous = each(np.float32, chunk, description.action_length)
        inputs |= {"previous": previous, "delay": each(np.int32)}
    return inputs


@contextlib.contextmanager
def _without_paths() -> Iterator[None]:
    """Keep the folders of this machine's source files out of the programs."""
    name = "jax_hlo_source_file_canonicalization_regex"
    before = jax.config.values[name]
    jax.config.update(name, "^.*/")
    try:
        yield
    finally:
        jax.config.update(name, before)


def _write_json(path: Path, values: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(values, indent=1) + "\n")
