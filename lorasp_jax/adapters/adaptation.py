"""Adapt a whole model by path rules; split, count and merge its parameters.

A rule is (pattern, method). Patterns are searched (`re.search`) in "/"-joined paths. The first
match wins, even if its method cannot apply to that path. For example, [("vision", LoRA()),
(".*", FullFineTuning())] leaves the vision tower's norms frozen. The method `None` skips the path.

The rule ("bias$", FullFineTuning()) also unfreezes the biases of adapted layers. It does not match
the paths of the layers themselves, so another rule can adapt them.
"""

import math
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters import paths
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.dense import AdaptedLayer, AdapterAux, AdapterParam, DropoutKey, validate
from lorasp_jax.kernels.quantized_weights import QuantizedKernel
from lorasp_jax.peft import FullFineTuning, Method
from lorasp_jax.peft.fields import checked_key
from lorasp_jax.peft.method import Params, dropout_rate

Model = TypeVar("Model", bound=nnx.Module)


class Counts(NamedTuple):
    """Parameter counts."""

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
    """Attach adapters to layers, or unfreeze base weights for full fine-tuning, by path rules.

    Adapters apply to every `Dense`, `nnx.Linear` (which becomes a `Dense`), `nnx.LinearGeneral` and
    `nnx.Einsum` whose path matches, for instance "language/gate_proj". LoRA also applies to
    `nnx.Embed` and `nnx.Conv`. Subclasses that override `__call__` are skipped. A stacked kernel
    `[L, I, O]` gets stacked adapters. An adapted layer's own weights are frozen.

    `FullFineTuning` converts every floating-point parameter under a matching path to an fp32
    `AdapterParam`, including norms, embeddings and biases.

    Args:
        model: not modified; the result shares its frozen arrays.
        rules: (pattern, method or None) pairs, first match wins.
        rngs: supplies one key, from which each layer derives its own by its path.
        einsums: extra layer classes that compute one einsum of their input and a parameter, mapped
            to a function layer -> (parameter name, equation), as in {gemma.Einsum: lambda layer:
            ("w", layer.einsum_str)}.
        statistics: second moments `[..., I, I]` of layer inputs by path, from
            `calibration.input_moments`; for data-driven initialization.

    Raises:
        ValueError: a pattern is not a valid regular expression, a rule applies to nothing (the
            message lists near misses), or a layer is unsupported or already has an adapter.
    """
    paths.check_method_rules(rules)
    nnx_layers.check_einsums(einsums)
    root, key = _wrapped_copy(model), validate.rngs(rngs).params()
    used = _attach_all(root, rules, key, einsums, statistics) | _unfreeze(root, rules)
    for i, (pattern, _) in enumerate(rules):
        if i not in used:
            known = [location.path for location in paths.locate_layers(root, einsums)]
            if taken := [path for path in known if re.search(pattern, path)]:
                first = ", ".join(taken[:3])
                raise ValueError(f"rule {pattern!r} applies to nothing: earlier rules take {first}")
            others = paths.unsupported_classes(root, einsums)
            raise ValueError(paths.no_match_message(pattern, known, others))
    return root[0]


def split(model: nnx.Module) -> tuple[nnx.GraphDef[Any], nnx.State[Any, Any], nnx.State[Any, Any]]:
    """Split a model into (graphdef, adapters, frozen); `adapters` is the trainable state.

    Differentiate with respect to `adapters` only; the gradient of the whole model would also train
    biases and unadapted layers.

    `nnx.merge(graphdef, adapters, frozen, copy=True)` restores the model. Inside jit or grad,
    models that use `nnx.scan` or `nnx.remat` need `copy=True`.
    """
    graphdef, adapters, frozen = nnx.split(_wrapped_copy(model)[0], AdapterParam, ...)
    return graphdef, adapters, frozen


def with_dropout(model: Model, key: jax.Array) -> Model:
    """Enable the adapters' `dropout` for one training step.

    Call this inside the loss, with a new key for each step:

        model = with_dropout(nnx.merge(graphdef, adapters, frozen, copy=True), key)

    `adapt`, `load_adapters`, `split` and `merge` return models with dropout off. The layers of a
    stack use independent masks. A layer called twice with the same input shape reuses its mask.

    Args:
        model: not modified; adapters without dropout are unaffected.
        key: typed PRNG key.
    """
    root, key = _wrapped_copy(model), checked_key(key)
    for location in paths.locate(root, AdaptedLayer):
        layer = location.child
        if isinstance(layer.adapter, AdapterParam) and dropout_rate(layer.method):
            layer_key = jax.random.fold_in(key, zlib.crc32(location.path.encode()))
            leading = layer.stack_shape()
            layer.stored_dropout_key = DropoutKey(
                jax.random.split(layer_key, leading) if leading else layer_key
            )
    return root[0]


def count(model: nnx.Module) -> Counts:
    """Count trainable and total parameters; also works on shapes (`nnx.eval_shape`).

    What pads the adapters of a stack to a common rank is not counted.
    """
    validate.module(model)
    unused = sum(padding(model).values())
    sizes = (_size(nnx.state(model, kind)) - unused for kind in (AdapterParam, nnx.Param))
    return Counts(*sizes)


def padding(model: nnx.Module) -> dict[str, int]:
    """Return how many parameters pad the adapter of a stack, by the adapter's path."""
    locations = paths.locate(nnx.List([model]), AdaptedLayer)
    once = {id(location.child): location for location in locations}  # a layer may be shared
    return {
        f"{path}/adapter": layer.method.unused(layer.adapter.get_value())
        for path, _, _, layer in once.values()
        if isinstance(layer.adapter, AdapterParam) and layer.method is not None
    }


def methods(model: nnx.Module) -> dict[str, Method]:
    """Return methods by the path of an adapted layer or of a fully fine-tuned parameter."""
    methods_by_path = {}
    validate.module(model)
    for path, parent, name, _ in paths.locate(nnx.List([model]), AdapterParam):
        if isinstance(parent, AdaptedLayer) and name == "adapter":
            methods_by_path[path.rpartition("/")[0]] = parent.method
        else:
            methods_by_path[path] = FullFineTuning()
    return methods_by_path


def merge(model: Model, pattern: str = ".*") -> Model:
    """Fold the adapters into the kernels; the result has no adapters and is entirely frozen.

    With a `pattern`, only layers and trained parameters whose path it matches, as in `adapt`, are
    merged; the others keep their adapters.

    An embedding's adapter affects only lookups and `attend`, but merging changes the table for all
    code that reads it. A quantized kernel with an adapter is dequantized.

    Raises:
        ValueError: a method's delta depends on the input, the model has shapes without values, or
            the pattern matches nothing that is trained.
    """
    paths.check_method_rules([(pattern, None)])
    root = _wrapped_copy(validate.with_values(model))
    trained = [location.path for location in paths.locate(root, AdapterParam)]
    if trained and not any(re.search(pattern, path) for path in trained):
        raise ValueError(paths.no_match_message(pattern, trained, {}))
    chosen = lambda kind: [x for x in paths.locate(root, kind) if re.search(pattern, x.path)]  # noqa: E731
    paths.replace(chosen(AdaptedLayer), _merged)
    _convert_variables([p for p in chosen(AdapterParam) if p.name != "adapter"], nnx.Param)
    return root[0]


def _merged(location: paths.Location) -> nnx.Module:
    """Fold the adapter into the kernel; return the layer without an adapter."""
    layer = location.child
    if layer.adapter is not None:
        with paths.naming("merge", location.path):
            kernel = layer.kernel_matrices()
            kernel = over_stack(layer.method.merge, kernel)(layer.adapter.get_value(), kernel)
        layer.set_kernel_matrices(kernel)
    return layer.without_adapter()


def penalties(model: nnx.Module) -> dict[str, jax.Array]:
    """Regularization losses by name, each averaged over all matrices whose method defines it."""
    losses: dict[str, list[jax.Array]] = {}
    for _, _, _, layer in paths.locate(nnx.List([validate.module(model)]), AdaptedLayer):
        if layer.adapter is not None:
            penalty = over_stack(layer.method.penalty, layer.kernel_matrices())
            for name, values in penalty(layer.adapter.get_value()).items():
                losses.setdefault(name, []).append(values.ravel())
    return {name: jnp.concatenate(values).mean() for name, values in losses.items()}


def attach(
    layer: AdaptedLayer, method: Method, key: jax.Array, statistics: jax.Array | None = None
) -> None:
    """Attach a newly initialized adapter to a layer, and freeze the layer's own weights.

    The layer is modified in place; leading axes of its kernel index the layers of a scanned stack.
    `statistics` are the second moments `[..., I, I]` of its inputs, if the method requires them.

    Raises:
        ValueError: the layer does not support the method or already has an adapter, the method is
            for another number of layers, or it would split a quantized kernel.
    """
    if layer.adapter is not None and layer.method is not None:
        raise ValueError(f"it already has a {layer.method.name} adapter: merge the model first")
    if method.splits_kernel and isinstance(layer.kernel_matrices(), QuantizedKernel):
        raise ValueError("a quantized kernel cannot be split: adapt first, then quantize")
    _convert_variables(
        [p for p in paths.locate(nnx.List([layer]), AdapterParam) if p.name != "adapter"], nnx.Param
    )
    init = layer.adapter_init(method)
    kernel: Any = layer.kernel_matrices()
    if method.splits_kernel and isinstance(kernel, np.ndarray):
        params, kernel = _split_on_host(key, init, kernel)
    else:
        params, kernel = init_stack(key, init, kernel, statistics)
    params = method.trimmed(params)
    layer.method = method
    if method.splits_kernel:
        layer.set_kernel_matrices(kernel)
    layer.adapter = AdapterParam(params)


def _wrapped_copy(model: nnx.Module) -> nnx.List[Any]:
    """Copy the model without stored aux and dropout keys, sharing its arrays.

    The copy is wrapped in a List so that the model can be replaced if it is itself a layer.
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
    """Attach adapters in place; return the indices of the rules used."""
    layers = paths.locate_layers(root, einsums)
    adapters = {i: m for i, (_, m) in enumerate(rules) if m is not None and not m.trains_base}
    found = {location.path: paths.find_rule(rules, location.path) for location in layers}
    methods = {path: None if i is None else adapters.get(i) for path, i in found.items()}

    def attach_to(location: paths.Location) -> AdaptedLayer | None:
        if (method := methods[location.path]) is None:
            return None
        layer_key = jax.random.fold_in(key, zlib.crc32(location.path.encode()))
        with paths.naming("adapt", location.path):
            layer = nnx_layers.make_adaptable(location.child, einsums)
            attach(layer, method, layer_key, statistics.get(location.path))
        return layer

    paths.replace(layers, attach_to)
    return adapters.keys() & found.values()


def _unfreeze(root: nnx.List[Any], rules: paths.Rules) -> set[int]:
    """Unfreeze base parameters in place; return the indices of the rules used."""
    used, unfrozen = set(), []
    for location in paths.locate(root, nnx.Param):
        i = paths.find_rule(rules, location.path.rpartition("/")[0], location.path)
        method = None if i is None else rules[i][1]
        if i is None or (method is not None and not method.trains_base):
            continue
        used.add(i)
        if method is not None and not isinstance(location.child, AdapterParam):
            if isinstance(location.child.get_value(), QuantizedKernel):
                raise ValueError(f"{location.path} is quantized and cannot be fully fine-tuned")
            layer = location.parent if isinstance(location.parent, AdaptedLayer) else None
            if layer and layer.adapter is None:
                layer.method = method
            elif layer and location.name == layer.kernel_name:
                raise ValueError(f"{location.path} has an adapter and cannot be fully fine-tuned")
            values = jax.tree.leaves(location.child.get_value())
            if all(jnp.issubdtype(value.dtype, jnp.floating) for value in values):
                unfrozen.append(location)
    _convert_variables(unfrozen, AdapterParam)
    return used


def _convert_variables(locations: Sequence[paths.Location], kind: type[nnx.Param]) -> None:
    """Convert variables to `kind`, preserving sharing; trainable ones become fp32."""

    def convert(location: paths.Location) -> nnx.Param:
        value = location.child.get_value()
        if kind is AdapterParam:  # a copy, since the train step may donate trainable arrays
            value = jax.tree.map(lambda x: jnp.array(x, jnp.float32, copy=True), value)
        return kind(value, **location.child.get_metadata())

    paths.replace(locations, convert)


def init_stack(
    key: jax.Array,
    init: Callable[..., Any],
    kernel: jax.Array,
    statistics: jax.Array | None = None,
) -> tuple[Params, Any]:
    """Apply a method's `init` to a kernel `[..., I, O]`, with an independent key per matrix.

    Not jitted as a whole, so that random draws compile once per I, not once per kernel shape.
    """
    leading = getattr(kernel, "shape", ())[:-2]
    if not leading:
        return init(key, kernel, statistics=statistics)
    d_in, d_out = kernel.shape[-2:]
    if statistics is not None:
        statistics = statistics.reshape(-1, d_in, d_in)
    keys = jax.random.split(key, math.prod(leading))
    each = jax.vmap(lambda key, kernel, moment: init(key, kernel, statistics=moment))
    stacked = each(keys, kernel.reshape(-1, d_in, d_out), statistics)
    return jax.tree.map(lambda leaf: leaf.reshape(*leading, *leaf.shape[1:]), stacked)


def _split_on_host(
    key: jax.Array, init: Callable[..., Any], kernel: np.ndarray
) -> tuple[Params, np.ndarray]:
    """Like `init_stack`, but leave the residual kernel in host memory, where the kernel is.

    The device, which may not hold the base unquantized, has one matrix at a time.
    """
    matrices = kernel.reshape(-1, *kernel.shape[-2:])
    keys = jax.random.split(key, len(matrices))
    pairs = zip(keys, matrices, strict=True)
    results = [jax.device_get(init(k, matrix)) for k, matrix in pairs]
    stack = lambda *x: np.stack(x).reshape(*kernel.shape[:-2], *x[0].shape)  # noqa: E731
    params, residual = jax.tree.map(stack, *results)
    return jax.tree.map(jnp.asarray, params), residual


def over_stack(function: Callable[..., Any], kernel: jax.Array) -> Callable[..., Any]:
    """Map a function of one layer's arrays over the leading axes of a kernel `[..., I, O]`."""
    for _ in kernel.shape[:-2]:
        function = jax.vmap(function)
    return function


def _size(tree: Any) -> int:
    leaves = jax.tree.leaves(tree, is_leaf=lambda node: isinstance(node, QuantizedKernel))
    return sum(math.prod(leaf.shape) for leaf in leaves)
