"""Adapting a whole model: attach methods by path rules, split, count, merge.

A rule is (pattern, method). Patterns are `re.search`ed in "/"-joined paths, and the first rule that
matches a path governs it, whether it can apply there or not: with [("vision", LoRA()),
(".*", FullFineTuning())] the vision tower's norms stay frozen. `None` leaves a path alone.
"""

import difflib
import math
import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.dense import AdapterAux, AdapterParam, Dense
from lorasp_jax.peft import FullFineTuning, Method
from lorasp_jax.peft.method import Params

Rules = Sequence[tuple[str, Method | None]]
Model = TypeVar("Model", bound=nnx.Module)


class Counts(NamedTuple):
    """Numbers of parameters."""

    trainable: int
    total: int


class Place(NamedTuple):
    """Where a layer or parameter hangs in a model: `getattr(parent, name)` is `child`."""

    path: str
    parent: Any
    name: str
    child: Any


def adapt(
    model: Model,
    rules: Rules,
    *,
    rngs: nnx.Rngs,
    statistics: Mapping[str, jax.Array] = MappingProxyType({}),
) -> Model:
    """Attaches adapters to dense layers, or frees base weights for full fine-tuning, by path rules.

    Additive methods apply to every `Dense` and `nnx.Linear` (which becomes a `Dense`) at its path,
    for instance "language/gate_proj". A stacked kernel [L, I, O] gets stacked adapters. The layer's
    own weights are frozen, and an adapter it already had is replaced.
    `FullFineTuning` applies to every parameter under the paths it matches, norms, embeddings and
    biases included, which becomes an fp32 `AdapterParam` in its place.

    Args:
      model: left untouched; the result shares its frozen arrays.
      rules: (pattern, method or None) pairs, first match wins.
      rngs: source of the adapters' keys. A layer's adapter depends on the key and its path alone.
      statistics: by path, [..., I, I] of `calibration.input_moments`, for what starts from data.

    Returns:
      The adapted model.

    Raises:
      ValueError: a rule that is no regular expression or governs nothing that it applies to (lists
        near misses), or a layer that an adapter cannot take over.
    """
    for pattern, _ in rules:
        try:
            re.compile(pattern)
        except re.error as error:
            raise ValueError(f"rule {pattern!r} is no regular expression: {error}.") from error
    holder, key = _copy(model), rngs.params()
    used = _attach_all(holder, rules, key, statistics) | _free_all(holder, rules)
    for i, (pattern, _) in enumerate(rules):
        if i not in used:
            raise ValueError(_no_match(pattern, holder))
    return holder[0]


def split(model: nnx.Module) -> tuple[nnx.GraphDef, nnx.State, nnx.State]:
    """(graphdef, adapters, frozen): the structure, what trains, and everything else.

    `nnx.merge(graphdef, adapters, frozen)` gives the model back, also inside jit and grad.
    """
    graphdef, adapters, frozen = nnx.split(_copy(model)[0], AdapterParam, ...)
    return graphdef, adapters, frozen


def count(model: nnx.Module) -> Counts:
    """How many parameters train, and how many there are; shapes suffice (`nnx.eval_shape`)."""
    return Counts(_size(nnx.state(model, AdapterParam)), _size(nnx.state(model, nnx.Param)))


def methods(model: nnx.Module) -> dict[str, Method]:
    """Method by path: of each layer with an adapter, and full fine-tuning of each parameter."""
    found = {}
    for path, parent, name, _ in places(nnx.List([model]), AdapterParam):
        if isinstance(parent, Dense) and name == "adapter":
            found[path.rpartition("/")[0]] = parent.method
        else:
            found[path] = FullFineTuning()
    return found


def merge(model: Model) -> Model:
    """A model without adapters that computes the same: deltas folded into kernels, all frozen.

    Raises:
      ValueError: a method whose delta depends on the input.
    """
    holder = _copy(model)
    for place in places(holder, Dense):
        layer = place.child
        if layer.adapter is not None:
            try:
                kernel = layer.kernel.get_value()
                kernel = _over_stack(layer.method.merge, kernel)(layer.adapter.get_value(), kernel)
            except ValueError as error:
                raise ValueError(f"cannot merge {place.path}: {error}") from error
            layer.kernel = _renewed(layer.kernel, kernel)
            layer.adapter = None
        layer.method = None
    _retype(places(holder, AdapterParam), nnx.Param)
    return holder[0]


def penalties(model: nnx.Module) -> dict[str, jax.Array]:
    """Each loss on parameters alone, averaged over the adapted matrices whose method has it."""
    found: dict[str, list[jax.Array]] = {}
    for _, _, _, layer in places(nnx.List([model]), Dense):
        if layer.adapter is not None:
            penalty = _over_stack(layer.method.penalty, layer.kernel.get_value())
            for name, values in penalty(layer.adapter.get_value()).items():
                found.setdefault(name, []).append(values.ravel())
    return {name: jnp.concatenate(values).mean() for name, values in found.items()}


def attach(
    layer: Dense | nnx.Linear, method: Method, key: jax.Array, statistics: jax.Array | None = None
) -> Dense:
    """The layer with a fresh adapter and its own weights frozen.

    Args:
      layer: kernel [..., I, O]; leading axes are layers of a scanned stack. A `Dense` is changed in
        place, an `nnx.Linear` replaced.
      method: an additive method.
      key: typed random key.
      statistics: [..., I, I] of the layer's inputs, where the method starts from them.

    Raises:
      ValueError: an `nnx.Linear` with a custom matrix product or precision, or a layer whose
        adapter holds a part of its kernel.
    """
    if isinstance(layer, nnx.Linear):
        layer = _as_dense(layer)
    if layer.adapter is not None and layer.method is not None and layer.method.splits_kernel:
        raise ValueError("an adapter that holds a part of its kernel cannot be replaced: merge it.")
    _retype([p for p in places(nnx.List([layer]), AdapterParam) if p.name != "adapter"], nnx.Param)
    layer.method = method
    params, kernel = _init(key, method, layer.kernel.get_value(), statistics)
    if method.splits_kernel:
        layer.kernel = _renewed(layer.kernel, kernel)
    layer.adapter = AdapterParam(params)
    return layer


def _copy(model: nnx.Module) -> nnx.List:
    """A holder of one copy of the model that shares its arrays, free of what layers kept.

    The holder gives a model that is itself one layer a parent to be replaced in.
    """
    model = nnx.clone(model)
    nnx.pop(model, AdapterAux)
    return nnx.List([model])


def places(holder: nnx.List, kind: type | tuple[type, ...]) -> list[Place]:
    """All children of a type, with paths that start below the holder."""

    def walk() -> Iterator[Place]:
        for path, module in nnx.iter_modules(holder):
            for name, child in vars(module).items():
                if isinstance(child, kind):
                    yield Place("/".join(map(str, (*path, name)[1:])), module, name, child)

    return list(walk())


def _governing(rules: Rules, *paths: str) -> int | None:
    """Index of the first rule that matches one of the paths."""
    hits = (i for i, (pattern, _) in enumerate(rules) if any(re.search(pattern, p) for p in paths))
    return next(hits, None)


def _attach_all(
    holder: nnx.List, rules: Rules, key: jax.Array, statistics: Mapping[str, jax.Array]
) -> set[int]:
    """Attaches additive adapters in place; returns the rules that were used."""
    used = set()
    for path, parent, name, layer in places(holder, (Dense, nnx.Linear)):
        i = _governing(rules, path)
        method = None if i is None else rules[i][1]
        if method is not None and not method.trains_base:
            own_key = jax.random.fold_in(key, zlib.crc32(path.encode()))
            setattr(parent, name, attach(layer, method, own_key, statistics.get(path)))
            used.add(i)
    return used


def _free_all(holder: nnx.List, rules: Rules) -> set[int]:
    """Makes base parameters trainable in place; returns the rules that were used."""
    used, freed = set(), []
    for place in places(holder, nnx.Param):
        i = _governing(rules, place.path.rpartition("/")[0], place.path)
        method = None if i is None else rules[i][1]
        if i is None or (method is not None and not method.trains_base):
            continue
        used.add(i)
        if method is not None and not isinstance(place.child, AdapterParam):
            if place.name == "kernel" and getattr(place.parent, "adapter", None) is not None:
                raise ValueError(f"{place.path} cannot train in full under the layer's adapter.")
            if isinstance(place.parent, Dense) and place.parent.adapter is None:
                place.parent.method = method
            if jnp.issubdtype(place.child.get_value().dtype, jnp.floating):
                freed.append(place)
    _retype(freed, AdapterParam)
    return used


def _retype(places: Sequence[Place], kind: type[nnx.Param]) -> None:
    """Replaces variables by ones of another type, shared ones by one; those that train are fp32."""
    renewed = {}
    for _, parent, name, variable in places:
        if id(variable) not in renewed:
            value = variable.get_value()
            if kind is AdapterParam:  # a copy: the train step may donate what trains
                value = jnp.array(value, jnp.float32, copy=True)
            renewed[id(variable)] = kind(value, **variable.get_metadata())
        setattr(parent, name, renewed[id(variable)])


def _renewed(variable: nnx.Param, value: jax.Array) -> nnx.Param:
    """A variable of its own with another value: the old one may be shared with other layers."""
    return type(variable)(value, **variable.get_metadata())


def _as_dense(linear: nnx.Linear) -> Dense:
    """A `Dense` that holds a linear layer's own variables."""
    if linear.dot_general is not jax.lax.dot_general or linear.precision is not None:
        raise ValueError("an nnx.Linear with its own dot_general or precision cannot be adapted.")
    has_bias, zeros = linear.bias is not None, nnx.initializers.zeros
    layer = Dense(1, 1, use_bias=has_bias, dtype=linear.dtype, kernel_init=zeros, rngs=nnx.Rngs(0))
    layer.kernel, layer.bias = linear.kernel, linear.bias
    return layer


def _init(
    key: jax.Array, method: Method, kernel: jax.Array, statistics: jax.Array | None
) -> tuple[Params, Any]:
    """`method.init` for a kernel [..., I, O]: one draw per leading index.

    Not jitted as a whole: its random draws compile once for each I instead of for each shape.
    """
    *leading, d_in, d_out = kernel.shape
    if not leading:
        return method.init(key, kernel, statistics=statistics)
    keys = jax.random.split(key, math.prod(leading))
    init = jax.vmap(lambda key, kernel, own: method.init(key, kernel, statistics=own))
    if statistics is not None:
        statistics = statistics.reshape(-1, d_in, d_in)
    found = init(keys, kernel.reshape(-1, d_in, d_out), statistics)
    return jax.tree.map(lambda leaf: leaf.reshape(*leading, *leaf.shape[1:]), found)


def _over_stack(function: Callable[..., Any], kernel: jax.Array) -> Callable[..., Any]:
    """A function of one layer's arrays, over the leading axes of a kernel [..., I, O]."""
    for _ in kernel.shape[:-2]:
        function = jax.vmap(function)
    return function


def near_misses(wanted: str, known: Sequence[str]) -> str:
    """A few of the known names, those that are most like the wanted one, or the first."""
    return ", ".join(difflib.get_close_matches(wanted, known, n=5, cutoff=0.3) or known[:5])


def _no_match(pattern: str, holder: nnx.List) -> str:
    paths = [place.path for place in places(holder, (Dense, nnx.Linear))]
    close = near_misses(pattern, paths) or "none"
    return f"rule {pattern!r} applies to nothing; dense layers here: {close}."


def _size(tree: Any) -> int:
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(tree))
