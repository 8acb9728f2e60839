"""Several named adapters in one model: switch, mix or sum them without recompilation.

    model = combine({"pour": model_pour, "press": model_press})
    model = choose(model, "pour")                                 # one adapter for the whole batch
    model = choose(model, {"pour": 0.5, "press": 0.5})            # a weighted sum
    model = choose(model, ["pour", "press", None, "pour"])        # one per example of a batch
    model = choose(model, None)                                   # the base

The choice is an array, so a new choice does not recompile a jitted function that takes the model as
an argument. The only exception is the first change between a shared and a per-example choice.
`extract(model, "pour")` gets one adapter, for example for `save_adapters`, and
`swap(model, "pour", other)` replaces it. For the math, see `combine.adapter_set`.
"""

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
from lorasp_jax.peft.fields import short
from lorasp_jax.peft.method import Params

Selection: TypeAlias = str | Mapping[str, float] | None
AdaptedLayers: TypeAlias = dict[str, AdaptedLayer]
"""Adapted layers, by path or by adapter name."""


def combine(models: Mapping[str, Model], *, rank: int | None = None) -> Model:
    """Combine the adapters of several models in one model; the first adapter is active initially.

    The models may differ in the methods, ranks and scales of their adapters, and in which layers
    are adapted. The result has no trainable parameters.

    Args:
        models: models by name, adapted from the same base; not modified. The result shares the
            base. A model without adapters reserves an empty slot for `swap`.
        rank: LoRA rank to reserve in each layer. None reserves the largest that any model has
            there.

    Raises:
        ValueError: there are no models, their bases differ, base weights are trainable, an adapter
            splits its kernel, or the rank of a LoRA exceeds `rank`.
    """
    if not models:
        raise ValueError("models must have at least one model")
    adapter_names = tuple(models)
    bases = {name: strip_adapters(model) for name, model in models.items()}
    adapters = {name: adapters_by_path(name, model) for name, model in models.items()}
    for name in adapter_names[1:]:
        _check_same_base(bases[adapter_names[0]], adapter_names[0], bases[name], name)
    root = nnx.List([bases[adapter_names[0]]])

    def make_combined(location: Location) -> AdaptedLayer | None:
        path = location.path
        layers = {name: adapters[name][path] for name in adapter_names if path in adapters[name]}
        return _combined_layer(location.child, adapter_names, layers, rank) if layers else None

    paths.replace(paths.locate(root, nnx.Module), make_combined)
    return choose(root[0], adapter_names[0])


def choose(model: Model, choice: Selection | Sequence[Selection] | jax.Array | np.ndarray) -> Model:
    """Select adapters; also works inside jit.

    A choice per example applies along the first axis of a layer's input (for einsums, the first
    one that is not in the kernel). If the model folds other axes into the batch axis, as in
    [B * cameras, ...], each example's rows must be contiguous.

    Args:
        model: from `combine`; not modified, the result shares its arrays.
        choice: a name, weights by name, or None for the base; a sequence of these, one per example
            of the batch; or an array from `weights`, f32 `[A]` or `[B, A]`.

    Raises:
        ValueError: the model has no named adapters, a name is unknown (the message lists near
            misses), or an array has the wrong shape.
    """
    chosen = weights(model, choice)
    model = nnx.clone(model)
    for location in adapter_sets(model):
        adapters = location.child.adapter
        leading = adapters.params.get_value()["bank"]["scale"].shape[:-1]
        adapters.choice = AdapterChoice(jnp.broadcast_to(chosen, (*leading, *chosen.shape)))
    return model


def weights(
    model: nnx.Module, choice: Selection | Sequence[Selection] | jax.Array | np.ndarray
) -> jax.Array:
    """Convert a choice to an f32 array `[A]` or `[B, A]`, for jitted functions that call `choose`.

    See `choose` for the arguments and errors.
    """
    adapter_names = names(model)
    if isinstance(choice, jax.Array | np.ndarray):
        array = choice
    elif choice is None or isinstance(choice, str | Mapping):
        array = np.array(_weight_row(adapter_names, choice))
    else:
        array = np.array([_weight_row(adapter_names, selection) for selection in choice])
    size = len(adapter_names)
    if array.ndim not in (1, 2) or array.shape[-1] != size or not len(array):
        raise ValueError(f"weights must be [{size}] or [B, {size}], got {array.shape}")
    return jnp.asarray(array, jnp.float32)


def names(model: nnx.Module) -> tuple[str, ...]:
    """Names of a combined model's adapters, in the order of their weights.

    Raises:
        ValueError: the model has no named adapters.
    """
    for location in adapter_sets(model):
        return location.child.method.names
    raise ValueError("the model has no named adapters: combine models first")


def extract(model: Model, name: str | None) -> Model:
    """Extract one adapter as a separate model, as it was before `combine`.

    The result can be trained, saved and merged. A LoRA's alpha becomes scale · rank.

    Args:
        model: from `combine`; not modified.
        name: the adapter; None returns the base without adapters.

    Raises:
        ValueError: the model has no named adapters, or the name is unknown (the message lists near
            misses).
    """
    adapter_names, result = names(model), strip_adapters(model)
    if name is None:
        return result
    index_of(adapter_names, name)
    return with_adapters(
        result,
        {
            location.path: (location.child, *get_adapter(location.child, name))
            for location in adapter_sets(model)
        },
    )


def with_adapters(
    base: Model, adapters: Mapping[str, tuple[AdaptedLayer, Method | None, Params]]
) -> Model:
    """Attach adapters to the layers of a base from `strip_adapters`, in place.

    `adapters` has, by path, a layer that supports the adapter, its method or None, and parameters.
    """

    def make_adapted(location: Location) -> AdaptedLayer | None:
        kind, method, params = adapters.get(location.path, (None, None, {}))
        if kind is None or method is None:
            return None
        layer = nnx_layers.make_adaptable_like(location.child, kind)
        layer.method, layer.adapter = method, AdapterParam(params)
        return layer

    root = nnx.List([base])
    paths.replace(paths.locate(root, nnx.Module), make_adapted)
    return root[0]


def swap(model: Model, name: str, other: nnx.Module) -> Model:
    """Replace the adapter `name` without recompilation.

    A LoRA can be replaced by any LoRA up to the rank that `combine` reserved. Other adapters can
    only be replaced by ones with the same method and settings. The current choice is kept.

    Args:
        model: from `combine`; not modified.
        name: the adapter to replace; the new one takes this name.
        other: model adapted from the same base.

    Raises:
        ValueError: as for `combine`, or the adapter does not fit the slot.
    """
    validate.with_values(other)
    index, adapters = index_of(names(model), name), adapters_by_path(name, other)
    _check_same_base(strip_adapters(model), "the combined model", strip_adapters(other), name)
    model = nnx.clone(model)
    locations = adapter_sets(model)
    if extra := sorted(adapters.keys() - {location.path for location in locations}):
        raise ValueError(f"{name} adapts {extra[0]}, but the combined model has no adapters there")
    for path, _, _, layer in locations:
        method, params = adapters[path].method_and_params() if path in adapters else (None, None)
        value = dict(layer.adapter.params.get_value())
        if layer.method.methods[index] != (None if _fits_bank(method) else method):
            required = layer.method.methods[index] or "LoRA"
            raise ValueError(f"{name} at {path} requires the method {required}, got {method}")
        if _fits_bank(method):
            slot = layer.method.bank_names.index(name)
            value["bank"] = set_slot(value["bank"], slot, method, params)
        else:
            value["others"] = value["others"] | {name: params}
        layer.adapter.params.set_value(value)
    return model


def strip_adapters(model: Model) -> Model:
    """Copy the model without its adapters, sharing the base; trainable base weights stay trainable.

    Raises:
        ValueError: an adapter split its kernel.
    """
    root = nnx.List([nnx.merge(*adaptation.split(model))])

    def strip(location: Location) -> nnx.Module | None:
        if location.child.adapter is None:
            return None
        if location.child.method.splits_kernel:
            raise ValueError(f"the adapter of {location.path} split the kernel: merge it first")
        return location.child.without_adapter()

    paths.replace(paths.locate(root, AdaptedLayer), strip)
    return root[0]


def adapters_by_path(name: str, model: nnx.Module) -> AdaptedLayers:
    """Adapted layers of the model called `name`, by path.

    Raises:
        ValueError: base weights are trainable, or the model is already combined.
    """
    if adapter_sets(model):
        raise ValueError(f"{name} is already a combined model: extract one adapter first")
    locations = paths.locate(nnx.List([model]), AdaptedLayer)
    layers = {p.path: p.child for p in locations if isinstance(p.child.adapter, AdapterParam)}
    if extra := sorted(adaptation.methods(model).keys() - layers.keys()):
        raise ValueError(f"{name} also trains {extra[0]}, which is not an adapter")
    return layers


def _check_same_base(first: nnx.Module, name: str, second: nnx.Module, other: str) -> None:
    """Raise ValueError unless two models without adapters have the same parameters."""
    params, other_params = (paths.by_path(nnx.state(x, nnx.Param)) for x in (first, second))
    for path in params | other_params:
        a, b = params.get(path), other_params.get(path)
        if a is not b and (a is None or b is None or not _equal(a, b)):
            raise ValueError(f"{name} and {other} have different bases, first at {path!r}")


def _equal(a: jax.Array, b: jax.Array) -> bool:
    return (a.shape, a.dtype) == (b.shape, b.dtype) and bool(jnp.array_equal(a, b))


def _combined_layer(
    layer: nnx.Module, adapter_names: tuple[str, ...], adapted: AdaptedLayers, rank: int | None
) -> AdaptedLayer:
    """Combine the layer's adapters into an `AdapterSet` with all weights 0."""
    layer = nnx_layers.make_adaptable_like(layer, next(iter(adapted.values())))
    adapters = {name: layer.method_and_params() for name, layer in adapted.items()}
    methods = [adapters[name][0] if name in adapters else None for name in adapter_names]
    if rank is None:
        rank = max([m.rank for m in methods if type(m) is LoRA], default=0)
    pairs = zip(adapter_names, methods, strict=True)
    bank_names = [name for name, method in pairs if _fits_bank(method)]
    shape = layer.kernel_matrices().shape
    bank = empty_bank(len(bank_names), rank, shape)
    for i, name in enumerate(bank_names):
        method, params = adapters.get(name, (None, None))
        bank = set_slot(bank, i, method, params)  # pyright: ignore[reportArgumentType]
    params = {"bank": bank, "others": {n: p for n, (m, p) in adapters.items() if not _fits_bank(m)}}
    layer.method = AdapterSet(adapter_names, tuple(None if _fits_bank(m) else m for m in methods))
    layer.adapter = NamedAdapters(params, jnp.zeros((*shape[:-2], len(adapter_names))))
    return layer


def _fits_bank(method: Method | None) -> TypeGuard[LoRA | None]:
    """Whether the adapter belongs in the bank of LoRAs: plain LoRA, or no adapter."""
    return method is None or type(method) is LoRA


def adapter_sets(model: nnx.Module) -> list[Location]:
    """Locations of the layers with named adapters."""
    locations = paths.locate(nnx.List([validate.module(model)]), AdaptedLayer)
    return [location for location in locations if isinstance(location.child.adapter, NamedAdapters)]


def get_adapter(layer: Any, name: str) -> tuple[Method | None, Params]:
    """Method and parameters of one adapter in a layer's set; the method is None if absent."""
    value = layer.adapter.params.get_value()
    if name in layer.method.others:
        return layer.method.others[name], value["others"][name]
    return get_slot(value["bank"], layer.method.bank_names.index(name))


def _weight_row(adapter_names: tuple[str, ...], selection: Selection) -> list[float]:
    """Convert a selection to one weight per adapter."""
    row = [0.0] * len(adapter_names)
    chosen = {selection: 1.0} if isinstance(selection, str) else selection or {}
    for name, weight in chosen.items():
        row[index_of(adapter_names, name)] = float(weight)
    return row


def index_of(adapter_names: tuple[str, ...], name: str) -> int:
    """Index of a name; raise ValueError with near misses if the name is unknown."""
    if name not in adapter_names:
        close = paths.near_misses(str(name), adapter_names)
        raise ValueError(f"unknown adapter {short(name)}; the model has {close}")
    return adapter_names.index(name)
