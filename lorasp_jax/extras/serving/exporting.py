"""Write a policy as a folder that runs without this package; `exported` describes it and reads it.

The programs are traced for the CPU, whose operations run on every platform: unlike in training,
they contain none of this project's GPU kernels.
"""

import contextlib
import dataclasses
import hashlib
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
from lorasp_jax.extras.serving.loading import Loaded
from lorasp_jax.extras.serving.policies import batch_sizes, describe, sample, without_prompts
from lorasp_jax.extras.serving.served import common_spec
from lorasp_jax.models.sampling import NUM_STEPS
from lorasp_jax.models.shared_base import SharedSampler
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.statistics import Statistics


def write(
    policy: Policy,
    folder: str | os.PathLike[str],
    *,
    continues: bool = False,
    num_steps: int = NUM_STEPS,
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
    settings = {"continues": continues, "num_steps": num_steps, "max_batch": max_batch}
    description = _describe(policy, **settings, metadata=metadata or {})
    with locked(folder), atomic_folder(folder) as unfinished:
        programs, weights = _Programs().export(policy, description)
        (unfinished / exported.WEIGHTS).write_bytes(safetensors.numpy.save(weights))
        for each, program in programs.items():
            (unfinished / exported.program_file(*each)).write_bytes(program)
        _write_texts(unfinished, policy, description, {})


def write_bundle(
    policies: Mapping[str, Loaded],
    folder: str | os.PathLike[str],
    *,
    num_steps: int | None = None,
    max_batch: int = 8,
) -> None:
    """Export policies of one base, which is stored once; see `exported.load_bundle`.

    Args:
        policies: by name, each with a `SharedSampler` as its model; the first is the default.
        folder: to be created, completely or not at all.
        num_steps: Euler steps of the flow-matching sampler; None: each policy has its own.
        max_batch: largest batch; see `batch_sizes`.

    Raises:
        ValueError: as for `write`, or the policies cannot be served together.
    """
    folder, traced = Path(folder), _Programs()
    descriptions = {
        name: _describe(
            each.policy,
            continues=bool(each.continues),
            num_steps=num_steps or each.denoise_steps,
            max_batch=max_batch,
            metadata=each.metadata,
        )
        for name, each in policies.items()
    }
    common_spec(descriptions)
    with locked(folder), atomic_folder(folder) as unfinished:
        base: dict[str, np.ndarray] = {}
        contents = {}
        for name, each in policies.items():
            programs, weights = traced.export(each.policy, descriptions[name])
            own = {n: array for n, array in weights.items() if not n.startswith("base/")}
            base |= {n: array for n, array in weights.items() if n not in own}
            (unfinished / name).mkdir()
            (unfinished / name / exported.WEIGHTS).write_bytes(safetensors.numpy.save(own))
            beside = {exported.BASE: exported.BASE}
            for kind_and_size, program in programs.items():
                file = f"program-{hashlib.sha256(program).hexdigest()[:16]}.bin"
                (unfinished / file).write_bytes(program)
                beside[exported.program_file(*kind_and_size)] = file
            contents[name] = {"beside": beside, "weights": [*weights]}
        (unfinished / exported.BASE).write_bytes(safetensors.numpy.save(base))
        for name, each in policies.items():
            _write_texts(unfinished / name, each.policy, descriptions[name], contents[name])
        (unfinished / exported.BUNDLE).write_text(json.dumps([*policies]) + "\n")


def _describe(
    policy: Policy, *, continues: bool, num_steps: int, max_batch: int, metadata: Mapping[str, Any]
) -> Description:
    """Describe a policy to export; errors are those of `write`."""
    if jax.default_backend() != "cpu":
        raise ValueError("policies are exported on the CPU: set JAX_PLATFORMS=cpu")
    if not policy.processor.prompts.instructions:
        raise ValueError("a policy without instructions cannot be exported")
    if num_steps < 1:
        raise ValueError(f"the number of flow steps must be at least 1, got {num_steps}")
    sizes = batch_sizes(max_batch)
    settings = {"num_steps": num_steps, "batch_sizes": sizes, "continues": continues}
    return describe(policy, **settings, metadata=metadata)


def _write_texts(
    folder: Path, policy: Policy, description: Description, more: Mapping[str, Any]
) -> None:
    """Write the JSON files beside a policy's weights and programs."""
    _write_json(folder / exported.INSTRUCTIONS, _tokens(policy))
    _write_json(folder / exported.PROCESSOR, _normalization(policy))
    _write_json(folder / exported.DESCRIPTION, _contents(folder, description, more))


def _tokens(policy: Policy) -> dict[str, Any]:
    """Return the tokens of each instruction as JSON values."""
    prompts = policy.processor.prompts
    own = slice(len(prompts.instructions))  # further rows have other endings
    ids, mask = (np.asarray(array)[own].tolist() for array in prompts.start)
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


def _contents(folder: Path, description: Description, more: Mapping[str, Any]) -> dict[str, Any]:
    """Return what policy.json contains; in a bundle, `more` says what is beside the folder."""
    paths = {name: folder / name for name in description.files}
    paths |= {name: folder.parent / file for name, file in more.get("beside", {}).items()}
    values = {
        "format": exported.FORMAT,
        "lorasp_jax": lorasp_jax.__version__,
        "jax": jax.__version_info__,
        "platforms": exported.PLATFORMS,
        "policy": dataclasses.asdict(description),
        "files": {name: exported.file_digest(path) for name, path in paths.items()},
        **more,
    }
    return {**values, "digest": exported.digest(values)}


class _Programs:
    """Exports policies, those with equal programs only once."""

    def __init__(self) -> None:
        self._known: dict[Any, tuple[dict[tuple[str, int], bytes], list[int]]] = {}

    def export(
        self, policy: Policy, description: Description
    ) -> tuple[dict[tuple[str, int], bytes], dict[str, np.ndarray]]:
        """Return programs, and the weights that they take by name, in order.

        Those of a `SharedSampler`'s base have names that begin with "base/".
        """
        bare = without_prompts(policy)
        statistics = _by_kind(bare.processor.statistics)
        bare = dataclasses.replace(
            bare, processor=dataclasses.replace(bare.processor, statistics=None)
        )
        leaves, tree = jax.tree.flatten(bare)
        shapes = [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves((leaves, statistics))]
        key = tree, tuple(shapes), description.num_steps, tuple(description.programs)
        if key not in self._known:
            self._known[key] = _export(tree, leaves, statistics, policy, description)
        programs, used = self._known[key]
        names = _names(bare, len(leaves))
        return programs, {names[i]: np.asarray(leaves[i]) for i in used}


def _names(policy: Policy, count: int) -> list[str]:
    """Name the leaves of a policy; those of a base alike in all policies that share it."""
    numbered = [f"{i:06}" for i in range(count)]
    if not isinstance(policy.model, SharedSampler):
        return numbered
    structure = policy.model.structure
    pairs = zip(structure.names, structure.own, strict=True)
    base = [f"base/{name}" for name, own in pairs if own is None]
    return [*base, *numbered[len(base) :]]


def _export(
    tree: Any,
    leaves: Sequence[jax.Array],
    statistics: Any,
    policy: Policy,
    description: Description,
) -> tuple[dict[tuple[str, int], bytes], list[int]]:
    """Export all programs of a policy's leaves; return also which leaves they take."""
    tokens = policy.processor.prompts.start.ids.shape[1]

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
    return {each: bytes(program.serialize()) for each, program in programs.items()}, used


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
