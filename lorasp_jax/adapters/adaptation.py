"""Adapting a whole model: attach methods by path rules, split, count, merge.

A rule is (pattern, method). Patterns are `re.search`ed in "/"-joined paths, and the first rule that
matches a path governs it, whether it can apply there or not: with [("vision", LoRA()),
(".*", FullFineTuning())] the vision tower's norms stay frozen. `None` leaves a path alone.

What Hugging Face PEFT has options for are rules here, the special ones first:

    rank_pattern, alpha_pattern    ("attn/q", LoRA(rank=4, alpha=32)), (".*", LoRA(rank=8))
    modules_to_save                ("head", FullFineTuning()), (".*", LoRA())
    bias="all"                     ("bias$", FullFineTuning()), (".*", LoRA())
    exclude_modules                ("head", None), (".*", LoRA())

A rule ("bias$", FullFineTuning()) frees biases of layers that another rule gives adapters to, since
their kernels have other paths.
"""

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.adapters import paths
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.dense import AdaptedLayer, AdapterAux, AdapterParam, DropoutKey, validate
from lorasp_jax.kernels.quantized_weights import QuantizedKernel
from lorasp_jax.peft import FullFineTuning, Method, _arguments
from lorasp_jax.peft._fields import short
from lorasp_jax.peft._method import Params, dropout_rate

Model = TypeVar("Model", bound=nnx.Module)


class Counts(NamedTuple):
    """Numbers of parameters."""

    trainable: int
    total: int


def adapt(
    model: Model,
    rules: paths.Rules,
    *,
    rngs: nnx.Rngs,
    einsums: nnx_layers.Einsums = MappingProxyType({}),
    statistics: Mapping[str, jax.Array] = MappingProxyType({}),
) -> Model:
    """Attaches adapters to layers, or frees base weights for full fine-tuning, by path rules.

    Adapters apply to every `Dense`, `nnx.Linear` (which becomes a `Dense`), `nnx.LinearGeneral` and
    `nnx.Einsum` at its path, for instance "language/gate_proj"; LoRA to `nnx.Embed` and `nnx.Conv`
    too. A stacked kernel [L, I, O] gets stacked adapters. The layer's own weights are frozen.
    Subclasses that are called differently are left alone.
    `FullFineTuning` applies to every parameter under the paths it matches, norms, embeddings and
    biases included, which becomes an fp32 `AdapterParam` in its place.

    Args:
      model: left untouched; the result shares its frozen arrays.
      rules: (pattern, method or None) pairs, first match wins.
      rngs: source of the adapters' keys. A layer's adapter depends on the key and its path alone.
      einsums: further layer classes that do nothing but an einsum of their input and a parameter,
        each with a function of the layer that gives the parameter's name and the equation, as in
        {gemma.Einsum: lambda layer: ("w", layer.einsum_str)}.
      statistics: by path, [..., I, I] of `calibration.input_moments`, for what starts from data.

    Returns:
      The adapted model.

    Raises:
      ValueError: a rule that is no regular expression or governs nothing that it applies to (lists
        near misses), a layer that an adapter cannot take over, or one that has an adapter already.
    """
    paths.check_method_rules(rules)
    nnx_layers.check_einsums(einsums)
    _check_statistics(statistics)
    root, key = _copy(model), validate.rngs(rngs).params()
    used = _attach_all(root, rules, key, einsums, statistics) | unfreeze(root, rules)
    for i, (pattern, _) in enumerate(rules):
        if i not in used:
            raise ValueError(_no_match_message(pattern, root, einsums))
    return root[0]


def split(model: nnx.Module) -> tuple[nnx.GraphDef[Any], nnx.State[Any, Any], nnx.State[Any, Any]]:
    """(graphdef, adapters, frozen): the structure, what trains, and everything else.

    A step takes its gradient with respect to `adapters` alone. In a model trained as a whole,
    biases and layers without an adapter would train too.

    `nnx.merge(graphdef, adapters, frozen, copy=True)` gives the model back, also inside jit and
    grad. Without `copy`, a model whose code has `nnx.scan` or `nnx.remat` cannot be called there.
    """
    graphdef, adapters, frozen = nnx.split(_copy(model)[0], AdapterParam, ...)
    return graphdef, adapters, frozen


def with_dropout(model: Model, key: jax.Array) -> Model:
    """The model for one training step, in which adapters with a `dropout` see parts of their input.

    Called inside the loss, with another key for each step:

        model = with_dropout(nnx.merge(graphdef, adapters, frozen, copy=True), key)

    All other models evaluate: those of `adapt` and `load_adapters`, and what `split`, `merge` and
    other functions make of the result. The layers of a stack draw apart from each other; a layer
    that is called twice drops the same places of both inputs, if they are of one shape.

    Args:
      model: left untouched; without such adapters the result computes the same.
      key: typed random key.
    """
    root, key = _copy(model), _arguments.key(key)
    for location in paths.unique(paths.locate(root, AdaptedLayer)):
        layer = location.child
        if isinstance(layer.adapter, AdapterParam) and dropout_rate(layer.method):
            own = jax.random.fold_in(key, zlib.crc32(location.path.encode()))
            leading = layer.stack_shape()
            layer.stored_dropout_key = DropoutKey(
                jax.random.split(own, leading) if leading else own
            )
    return root[0]


def count(model: nnx.Module) -> Counts:
    """How many parameters train, and how many there are; shapes suffice (`nnx.eval_shape`)."""
    validate.module(model)
    return Counts(_size(nnx.state(model, AdapterParam)), _size(nnx.state(model, nnx.Param)))


def methods(model: nnx.Module) -> dict[str, Method]:
    """Method by path: of each layer with an adapter, and full fine-tuning of each parameter."""
    found = {}
    validate.module(model)
    for path, parent, name, _ in paths.locate(nnx.List([model]), AdapterParam):
        if isinstance(parent, AdaptedLayer) and name == "adapter":
            found[path.rpartition("/")[0]] = parent.method
        else:
            found[path] = FullFineTuning()
    return found


def merge(model: Model) -> Model:
    """A model without adapters that computes the same: deltas folded into kernels, all frozen.

    Of an embedding, `attend` is adapted as lookups are; a table that the model reads past both is
    not, but merging changes it. A quantised kernel under an adapter becomes an array again.

    Raises:
      ValueError: a method whose delta depends on the input, or a model without values.
    """
    root = _copy(validate.with_values(model))
    paths.replace(paths.locate(root, AdaptedLayer), _merged)
    _convert_variables(paths.locate(root, AdapterParam), nnx.Param)
    return root[0]


def _merged(location: paths.Location) -> nnx.Module:
    """The layer without its adapter, whose delta its kernel has."""
    layer = location.child
    if layer.adapter is not None:
        try:
            kernel = layer.kernel_matrices()
            kernel = over_stack(layer.method.merge, kernel)(layer.adapter.get_value(), kernel)
        except ValueError as error:
            raise ValueError(f"cannot merge {location.path}: {error}") from error
        layer.set_kernel_matrices(kernel)
    return layer.without_adapter()


def penalties(model: nnx.Module) -> dict[str, jax.Array]:
    """Each loss on parameters alone, averaged over the adapted matrices whose method has it."""
    found: dict[str, list[jax.Array]] = {}
    for _, _, _, layer in paths.locate(nnx.List([validate.module(model)]), AdaptedLayer):
        if layer.adapter is not None:
            penalty = over_stack(layer.method.penalty, layer.kernel_matrices())
            for name, values in penalty(layer.adapter.get_value()).items():
                found.setdefault(name, []).append(values.ravel())
    return {name: jnp.concatenate(values).mean() for name, values in found.items()}


def attach(
    layer: AdaptedLayer, method: Method, key: jax.Array, statistics: jax.Array | None = None
) -> None:
    """Gives the layer a fresh adapter and freezes its own weights.

    Args:
      layer: changed in place. Leading axes of its kernel are layers of a scanned stack.
      method: an additive method.
      key: typed random key.
      statistics: [..., I, I] of the layer's inputs, where the method starts from them.

    Raises:
      ValueError: a method that the layer cannot carry, a layer that has an adapter, or a quantised
        kernel of which the method would take a part.
    """
    if layer.adapter is not None and layer.method is not None:
        raise ValueError(
            f"its {layer.method.name} adapter would be lost: adapt the base instead, merge the "
            "model first, or leave this layer out by a rule with None in front."
        )
    if method.splits_kernel and isinstance(layer.kernel_matrices(), QuantizedKernel):
        raise ValueError("a quantised kernel cannot be split: adapt first, then quantise the rest.")
    _convert_variables(
        [p for p in paths.locate(nnx.List([layer]), AdapterParam) if p.name != "adapter"], nnx.Param
    )
    init = layer.adapter_init(method)
    params, kernel = init_stack(key, init, layer.kernel_matrices(), statistics)
    layer.method = method
    if method.splits_kernel:
        layer.set_kernel_matrices(kernel)
    layer.adapter = AdapterParam(params)


def _check_statistics(statistics: Any) -> None:
    """Raises a ValueError unless these are matrices of finite numbers by path."""
    if not isinstance(statistics, Mapping):
        wanted = "statistics are those of calibration.input_moments, by path"
        raise ValueError(f"{wanted}, got {short(statistics)}.")
    for path, value in statistics.items():
        shape = getattr(value, "shape", (0, 1))
        traced = isinstance(value, jax.core.Tracer)
        if shape[-2:] != shape[-1:] * 2 or not (traced or jnp.isfinite(value).all()):
            raise ValueError(
                f"statistics of {path} must be finite numbers [I, I], got {short(value)}."
            )


def _copy(model: nnx.Module) -> nnx.List[Any]:
    """A holder of one copy of the model that shares its arrays, free of what calls need or leave.

    The holder gives a model that is itself one layer a parent to be replaced in.
    """
    model = nnx.clone(validate.module(model))
    nnx.pop(model, nnx.Any(AdapterAux, DropoutKey))
    return nnx.List([model])


def _attach_all(
    root: nnx.List[Any],
    rules: paths.Rules,
    key: jax.Array,
    einsums: nnx_layers.Einsums,
    statistics: Mapping[str, jax.Array],
) -> set[int]:
    """Attaches adapters in place; returns the rules that were used."""
    used: dict[str, int] = {}
    found = paths.locate_layers(root, einsums)
    for location in found:
        i = paths.find_rule(rules, location.path)
        method = None if i is None else rules[i][1]
        if i is not None and method is not None and not method.trains_base:
            used[location.path] = i

    def attached(location: paths.Location) -> AdaptedLayer | None:
        if location.path not in used:
            return None
        method = cast(Method, rules[used[location.path]][1])
        own_key = jax.random.fold_in(key, zlib.crc32(location.path.encode()))
        try:
            layer = nnx_layers.adapted(location.child, einsums)
            attach(layer, method, own_key, statistics.get(location.path))
        except ValueError as error:
            raise ValueError(f"cannot adapt {location.path or 'the model'}: {error}") from error
        return layer

    paths.replace(found, attached)
    return set(used.values())


def unfreeze(root: nnx.List[Any], rules: paths.Rules) -> set[int]:
    """Makes base parameters trainable in place; returns the rules that were used."""
    used, freed = set(), []
    for location in paths.locate(root, nnx.Param):
        i = paths.find_rule(rules, location.path.rpartition("/")[0], location.path)
        method = None if i is None else rules[i][1]
        if i is None or (method is not None and not method.trains_base):
            continue
        used.add(i)
        if method is not None and not isinstance(location.child, AdapterParam):
            if isinstance(location.child.get_value(), QuantizedKernel):
                raise ValueError(f"{location.path} is quantised and cannot train in full.")
            layer = location.parent if isinstance(location.parent, AdaptedLayer) else None
            if layer and layer.adapter is None:
                layer.method = method
            elif layer and location.name == layer.kernel_name:
                raise ValueError(f"{location.path} cannot train in full under the layer's adapter.")
            if jnp.issubdtype(location.child.get_value().dtype, jnp.floating):
                freed.append(location)
    if shapes := [p for p in freed if isinstance(p.child.get_value(), jax.ShapeDtypeStruct)]:
        raise ValueError(f"{shapes[0].path} has no value: call this within nnx.eval_shape.")
    _convert_variables(freed, AdapterParam)
    return used


def _convert_variables(locations: Sequence[paths.Location], kind: type[nnx.Param]) -> None:
    """Replaces variables by ones of another type, shared ones by one; those that train are fp32."""

    def renewed(location: paths.Location) -> nnx.Param:
        value = location.child.get_value()
        if kind is AdapterParam:  # a copy: the train step may donate what trains
            value = jnp.array(value, jnp.float32, copy=True)
        return kind(value, **location.child.get_metadata())

    paths.replace(locations, renewed)


def init_stack(
    key: jax.Array,
    init: Callable[..., Any],
    kernel: jax.Array,
    statistics: jax.Array | None = None,
) -> tuple[Params, Any]:
    """A method's `init` for a kernel [..., I, O]: one draw per leading index.

    Not jitted as a whole: its random draws compile once for each I instead of for each shape.
    """
    if len(getattr(kernel, "shape", ())) < 2:
        raise ValueError(f"an adapter needs a kernel [..., I, O], got {short(kernel)}.")
    *leading, d_in, d_out = kernel.shape
    if not leading:
        return init(key, kernel, statistics=statistics)
    if statistics is not None:
        statistics = statistics.reshape(-1, d_in, d_in)
    keys = jax.random.split(key, math.prod(leading))
    each = jax.vmap(lambda key, kernel, own: init(key, kernel, statistics=own))
    found = each(keys, kernel.reshape(-1, d_in, d_out), statistics)
    return jax.tree.map(lambda leaf: leaf.reshape(*leading, *leaf.shape[1:]), found)


def over_stack(function: Callable[..., Any], kernel: jax.Array) -> Callable[..., Any]:
    """A function of one layer's arrays, over the leading axes of a kernel [..., I, O]."""
    for _ in kernel.shape[:-2]:
        function = jax.vmap(function)
    return function


def _no_match_message(pattern: str, root: nnx.List[Any], einsums: nnx_layers.Einsums) -> str:
    known = [location.path for location in paths.locate_layers(root, einsums)]
    others = paths.locate_other_matrices(root, einsums)
    classes = {p.path.rpartition("/")[0]: type(p.parent).__name__ for p in others}
    return paths.no_match_message(pattern, known, classes)


def _size(tree: Any) -> int:
    leaves = jax.tree.leaves(tree, is_leaf=lambda node: isinstance(node, QuantizedKernel))
    return sum(math.prod(leaf.shape) for leaf in leaves)
