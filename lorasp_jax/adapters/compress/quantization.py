"""A frozen base in fewer bits, under adapters or before them (QLoRA, arXiv 2305.14314).

    model, errors = quantize(model, [("vision", None), (".*", "nf4")])

The kernels of dense layers and einsums shrink to 8 or 4.5 bits a weight, an einsum's with inputs
flattened; adapters, biases, norms, embeddings and convolutions stay. Everything else works as
before: gradients reach x and the adapters, adapters are saved alone and can be attached and
combined. `merge` gives the layers it merges a whole kernel again, that of the quantised layer
with the delta added.

Adapters that take a part of a kernel (PiSSA, OLoRA) come first, and what they leave is quantised.
"""

import re
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.dense import AdaptedLayer, AdapterParam, validate
from lorasp_jax.kernels.quantized_weights import KINDS, Kind, QuantizedKernel, quantize_kernel
from lorasp_jax.peft._fields import short

# By identity of a variable, equation and kind: what replaces it, the variable itself, which so
# stays alive, and the error.
Shared: TypeAlias = dict[tuple[int, str, Kind], tuple[nnx.Param[Any], nnx.Param[Any], float]]


class Quantized(NamedTuple):
    """A model with quantised kernels, and what that costs.

    Attributes:
      model: like the one given.
      errors: ‖W − Ŵ‖ / ‖W‖ by path, Frobenius, of a whole stack at once: what the layer's output is
        off by, relative to itself, for inputs that are as long in every direction.
    """

    model: nnx.Module
    errors: dict[str, float]


def quantize(model: nnx.Module, rules: Sequence[tuple[str, Kind | None]]) -> Quantized:
    """Quantises the kernels of dense layers and einsums by path rules.

    Args:
      model: not modified; the result shares everything else with it.
      rules: (pattern, "int8" or "nf4" or None) pairs over the paths of `Dense`, `nnx.Linear`,
        `nnx.LinearGeneral`, `nnx.Einsum` and of other einsum classes that are adapted already, as
        for `adapt`: the first that matches governs, None leaves alone.

    Raises:
      ValueError: a rule that governs no layer (lists near misses), an unknown kind, or a kernel
        that trains, is quantised already or is not finite.
    """
    kinds = " or ".join(map(repr, (*KINDS, None)))
    paths.check_rules(rules, lambda kind: kind in (*KINDS, None), kinds)
    validate.with_values(model)
    root, errors, used = nnx.List([nnx.merge(*adaptation.split(model))]), {}, set()
    shared: Shared = {}
    known = paths.locate_matmul_layers(root)
    for location in known:
        matching = [rule for rule in rules if re.search(rule[0], location.path)]
        if not matching:
            continue
        used.add(matching[0])
        if (kind := matching[0][1]) is not None:
            try:
                layer, errors[location.path] = _quantized(location.child, kind, shared)
            except ValueError as error:
                raise ValueError(f"cannot quantise {location.path}: {error}") from error
            paths.set_child(location, layer)
    for rule in rules:
        if rule not in used:
            close = paths.near_misses(rule[0], [location.path for location in known]) or "none"
            raise ValueError(
                f"rule {short(rule[0])} governs nothing; dense layers and einsums here: {close}."
            )
    return Quantized(root[0], errors)


def is_quantized(model: nnx.Module) -> bool:
    """Whether a kernel of the model is quantised."""
    parameters = paths.locate(nnx.List([model]), nnx.Param)
    return any(isinstance(location.child.get_value(), QuantizedKernel) for location in parameters)


def _quantized(layer: nnx.Module, kind: Kind, shared: Shared) -> tuple[AdaptedLayer, float]:
    """The layer with a quantised kernel, and its relative error; shared kernels stay shared."""
    layer = nnx_layers.make_adaptable(layer, {})
    variable, kernel = layer.kernel_variable(), layer.kernel_matrices()
    if isinstance(variable, AdapterParam):
        raise ValueError("its kernel trains, and what trains needs all of its bits.")
    if isinstance(kernel, QuantizedKernel):
        raise ValueError("its kernel is quantised already.")
    key = id(variable), getattr(layer, "kernel_equation", ""), kind
    if key not in shared:
        smaller = quantize_kernel(kernel, kind)
        layer.set_kernel_matrices(smaller)
        shared[key] = layer.kernel_variable(), variable, float(_error(kernel, smaller))
    new, _, error = shared[key]
    layer.set_kernel_variable(new)
    return layer, error


@jax.jit
def _error(kernel: jax.Array, smaller: QuantizedKernel) -> jax.Array:
    """‖W − Ŵ‖ / ‖W‖, 0 for a kernel of zeros."""
    whole = kernel.astype(jnp.float32)
    length = jnp.linalg.norm(whole)
    lost = jnp.linalg.norm(whole - smaller.astype(jnp.float32))
    return jnp.where(length > 0, lost / length, 0.0)
