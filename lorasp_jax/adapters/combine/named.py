"""Several named adapters in one model: switched, mixed or summed without compiling again.

    model = combine({"pour": model_pour, "press": model_press})
    model = choose(model, "pour")                                 # one for the whole batch
    model = choose(model, {"pour": 0.5, "press": 0.5})            # a weighted sum
    model = choose(model, ["pour", "press", None, "pour"])        # one for each example of a batch
    model = choose(model, None)                                   # the base

A choice is an array of the model and no part of its structure, so a jitted function that gets the
model as an argument runs on after another choice (once more compiled for choices by example, whose
array has the batch's axis too). One adapter alone is `extract(model, "pour")`, to be saved by
`save_adapters`, and gets back, or another in its place, by `swap(model, "pour", other)`.
`lorasp_jax.adapters.combine.adapter_set` has the maths.
"""

import math
import numbers
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias, TypeGuard

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.adaptation import Model
from lorasp_jax.adapters.combine.adapter_set import (
    AdapterChoice,
    AdapterSet,
    NamedAdapters,
    empty_bank,
    get_slot,
    set_slot,
)
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.adapters.paths import Location
from lorasp_jax.dense import AdaptedLayer, AdapterParam, validate
from lorasp_jax.peft import LoRA, Method
from lorasp_jax.peft._fields import short
from lorasp_jax.peft._method import MAX_SIZE, Params

One: TypeAlias = str | Mapping[str, float] | None
Adapters: TypeAlias = dict[str, AdaptedLayer]
"""Layers with an adapter, by path of the layer or by name of the model."""


def combine(models: Mapping[str, Model], *, rank: int | None = None) -> Model:
    """One model with the adapters of several; the first is chosen at first.

    The adapters may differ in method, rank and scale and in the layers that they adapt, which may
    be of every kind that `adapt` knows. Nothing trains in the result.

    Args:
      models: adapted from one base, by name; not modified. The result shares their base. A bare
        base is an empty place for `swap`.
      rank: room for each LoRA in each adapted layer, None: the largest that is there.

    Raises:
      ValueError: no models, another base, a base weight that trains, an adapter that holds a part
        of its kernel, or a LoRA that exceeds `rank`.
    """
    if not isinstance(models, Mapping) or not models or not all(map(_is_text, models)):
        raise ValueError("models to combine are a mapping by name, a text, and at least one.")
    for model in models.values():
        validate.with_values(model)
    if rank is not None and not (type(rank) is int and 0 <= rank <= MAX_SIZE):
        raise ValueError(
            f"rank must be a whole number up to {MAX_SIZE} or None, got {short(rank)}."
        )
    known = tuple(models)
    bases = {name: bare(model) for name, model in models.items()}
    adapters = {name: adapters_by_path(name, model) for name, model in models.items()}
    for name in known[1:]:
        _check_same(bases[known[0]], known[0], bases[name], name)
    root = nnx.List([bases[known[0]]])

    def with_set(location: Location) -> AdaptedLayer | None:
        found = {n: adapters[n][location.path] for n in known if location.path in adapters[n]}
        return _with_set(location.child, known, found, rank) if found else None

    paths.replace(paths.locate(root, nnx.Module), with_set)
    return choose(root[0], known[0])


def choose(model: Model, choice: One | Sequence[One] | jax.Array | np.ndarray) -> Model:
    """The model with another choice among its adapters; also inside jit.

    Args:
      model: from `combine`; not modified, the result shares its arrays.
      choice: a name, weights by name, or None for the base; a sequence of those, one for each
        example of the batch; or an array of `weights`, f32 [A] or [B, A]. The batch is the first
        axis of a layer's input, of an einsum's the first that its kernel lacks. Where the model
        folds other axes into it, as in [B * cameras, ...], an example's rows are in turn.

    Raises:
      ValueError: a model without named adapters, an unknown name (lists near misses), or an array
        of another shape.
    """
    chosen = weights(model, choice)
    model = nnx.clone(model)
    for location in sets(model):
        held = location.child.adapter
        leading = held.params.get_value()["bank"]["scale"].shape[:-1]
        held.choice = AdapterChoice(jnp.broadcast_to(chosen, (*leading, *chosen.shape)))
    return model


def weights(model: nnx.Module, choice: One | Sequence[One] | jax.Array | np.ndarray) -> jax.Array:
    """The array of a choice, f32 [A] or [B, A], for a jitted function that calls `choose`.

    Arguments and errors as for `choose`.
    """
    known = names(model)
    if isinstance(choice, jax.Array | np.ndarray):
        found = choice
    elif choice is None or isinstance(choice, str | Mapping):
        found = np.array(_row(known, choice))
    elif isinstance(choice, Sequence) and all(
        one is None or isinstance(one, str | Mapping) for one in choice
    ):
        found = np.array([_row(known, one) for one in choice])
    else:
        raise ValueError(
            f"a choice is a name, weights by name, None, or a list of these, got {short(choice)}."
        )
    size = len(known)
    if (
        found.ndim not in (1, 2)
        or found.shape[-1] != size
        or not len(found)
        or found.dtype.kind != "f"
    ):
        raise ValueError(
            f"weights of {size} adapters are floats of shape [{size}] or [B, {size}], got "
            f"{found.dtype} {found.shape}."
        )
    return jnp.asarray(found, jnp.float32)


def names(model: nnx.Module) -> tuple[str, ...]:
    """The names of a combined model's adapters, in the order of their weights.

    Raises:
      ValueError: the model has none.
    """
    for location in sets(model):
        return location.child.method.names
    raise ValueError("the model has no named adapters: combine models first.")


def extract(model: Model, name: str | None) -> Model:
    """A model with one of the adapters alone, as before `combine`: to train, save or merge it.

    A LoRA comes back with its rank and scale, however they were stated.

    Args:
      model: from `combine`; not modified.
      name: of the adapter; None for the bare base.

    Raises:
      ValueError: a model without named adapters, or an unknown name (lists near misses).
    """
    known, result = names(model), bare(model)
    if name is None:
        return result
    index_of(known, name)
    return with_adapters(
        result,
        {
            location.path: (location.child, *member(location.child, name))
            for location in sets(model)
        },
    )


def with_adapters(
    base: Model, adapters: Mapping[str, tuple[AdaptedLayer, Method | None, Params]]
) -> Model:
    """The base, whose layers get adapters of their own by path; it is changed in place.

    Args:
      base: from `bare`.
      adapters: a layer of the kind that can carry it, the method, None for no adapter, and the
        parameters.
    """

    def with_own(location: Location) -> AdaptedLayer | None:
        kind, method, params = adapters.get(location.path, (None, None, {}))
        if kind is None or method is None:
            return None
        layer = nnx_layers.make_adaptable_like(location.child, kind)
        layer.method, layer.adapter = method, AdapterParam(params)
        return layer

    root = nnx.List([base])
    paths.replace(paths.locate(root, nnx.Module), with_own)
    return root[0]


def swap(model: Model, name: str, other: nnx.Module) -> Model:
    """The model with another adapter in the place of the one called `name`, without recompiling.

    LoRAs of any scale fit each other's places, up to the room that `combine` made; other methods
    need the same settings. What is chosen stays chosen.

    Args:
      model: from `combine`; not modified.
      name: the place; it keeps its name.
      other: adapted from the same base.

    Raises:
      ValueError: as for `combine`, or an adapter that does not fit the place.
    """
    validate.with_values(other)
    index, adapters = index_of(names(model), name), adapters_by_path(name, other)
    _check_same(bare(model), "the combined model", bare(other), name)
    model = nnx.clone(model)
    locations = sets(model)
    if beyond := sorted(adapters.keys() - {location.path for location in locations}):
        raise ValueError(f"{name} adapts {beyond[0]}, where the combined model has no adapters.")
    for path, _, _, layer in locations:
        method, params = adapters[path].method_and_params() if path in adapters else (None, None)
        value = dict(layer.adapter.params.get_value())
        if layer.method.methods[index] != (None if _is_banked(method) else method):
            raise ValueError(f"{name} at {path} needs {layer.method.methods[index] or 'a LoRA'}.")
        if _is_banked(method):
            slot = layer.method.banked.index(name)
            value["bank"] = set_slot(value["bank"], slot, method, params)
        else:
            value["others"] = value["others"] | {name: params}
        layer.adapter.params.set_value(value)
    return model


def bare(model: Model) -> Model:
    """A copy without adapters that shares the base; base weights that train are left as they are.

    Raises:
      ValueError: an adapter holds a part of its kernel.
    """
    root = nnx.List([nnx.merge(*adaptation.split(model))])

    def without(location: Location) -> nnx.Module | None:
        if location.child.adapter is None:
            return None
        if location.child.method.splits_kernel:
            raise ValueError(
                f"the adapter of {location.path} split the kernel, so the original base is not "
                "available: merge the adapter first."
            )
        return location.child.without_adapter()

    paths.replace(paths.locate(root, AdaptedLayer), without)
    return root[0]


def adapters_by_path(name: str, model: nnx.Module) -> Adapters:
    """Every adapted layer by path.

    Raises:
      ValueError: something else trains too, or the model was combined already.
    """
    if sets(model):
        raise ValueError(f"{name} has named adapters already: extract one of them.")
    found = own_adapters(model)
    if beyond := sorted(adaptation.methods(model).keys() - found.keys()):
        raise ValueError(f"{name} trains {beyond[0]}; only adapters of layers have names.")
    return found


def own_adapters(model: nnx.Module) -> Adapters:
    """The layers with an adapter of their own, by path."""
    locations = paths.locate(nnx.List([model]), AdaptedLayer)
    return {p.path: p.child for p in locations if isinstance(p.child.adapter, AdapterParam)}


def _check_same(one: nnx.Module, name: str, two: nnx.Module, other: str) -> None:
    """Raises a ValueError unless two bare models have the same parameters."""
    first, second = _parameters(one), _parameters(two)
    for path in first | second:
        a, b = first.get(path), second.get(path)
        if a is not b and (a is None or b is None or not _equal(a, b)):
            raise ValueError(f"{name} and {other} have different bases, first at {path!r}.")


def _parameters(model: nnx.Module) -> dict[str, Any]:
    """Leaves by path."""
    state = nnx.to_pure_dict(nnx.state(model, nnx.Param))
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def _equal(a: jax.Array, b: jax.Array) -> bool:
    return (a.shape, a.dtype) == (b.shape, b.dtype) and bool(jnp.array_equal(a, b))


def _with_set(
    layer: nnx.Module, known: tuple[str, ...], found: Adapters, rank: int | None
) -> AdaptedLayer:
    """The layer with what was found for it as a set, of whose weights all are 0."""
    layer = nnx_layers.make_adaptable_like(layer, next(iter(found.values())))
    own = {name: adapted.method_and_params() for name, adapted in found.items()}
    methods = [own[name][0] if name in own else None for name in known]
    if rank is None:
        rank = max([m.rank for m in methods if type(m) is LoRA], default=0)
    banked = [name for name, method in zip(known, methods, strict=True) if _is_banked(method)]
    shape = layer.kernel_matrices().shape
    bank = empty_bank(len(banked), rank, shape)
    for i, name in enumerate(banked):
        method, params = own.get(name, (None, None))
        bank = set_slot(bank, i, method, params)  # pyright: ignore[reportArgumentType]
    params = {"bank": bank, "others": {n: p for n, (m, p) in own.items() if not _is_banked(m)}}
    layer.method = AdapterSet(known, tuple(None if _is_banked(m) else m for m in methods))
    layer.adapter = NamedAdapters(params, jnp.zeros((*shape[:-2], len(known))))
    return layer


def _is_text(name: Any) -> bool:
    return isinstance(name, str)


def _is_banked(method: Method | None) -> TypeGuard[LoRA | None]:
    """Whether a place in the bank of LoRAs fits: for plain LoRA, and for no adapter."""
    return method is None or type(method) is LoRA


def sets(model: nnx.Module) -> list[Location]:
    """The layers that hold named adapters."""
    locations = paths.locate(nnx.List([validate.module(model)]), AdaptedLayer)
    return [location for location in locations if isinstance(location.child.adapter, NamedAdapters)]


def member(layer: Any, name: str) -> tuple[Method | None, Params]:
    """One adapter of a layer's set, or None twice where the layer does not have it."""
    value = layer.adapter.params.get_value()
    if name in layer.method.others:
        return layer.method.others[name], value["others"][name]
    return get_slot(value["bank"], layer.method.banked.index(name))


def _row(known: tuple[str, ...], one: One) -> list[float]:
    """One choice as a weight for each adapter."""
    row = [0.0] * len(known)
    chosen = {one: 1.0} if isinstance(one, str) else one or {}
    for name, weight in chosen.items():
        if not isinstance(weight, numbers.Real) or not math.isfinite(weight):
            raise ValueError(
                f"the weight of {short(name)} must be a finite number, got {short(weight)}."
            )
        row[index_of(known, name)] = float(weight)
    return row


def index_of(known: tuple[str, ...], name: str) -> int:
    """The place of a name; raises a ValueError that lists near misses for an unknown one."""
    if name not in known:
        close = paths.near_misses(str(name), known)
        raise ValueError(f"there is no adapter {short(name)}; the model has {close}.")
    return known.index(name)
