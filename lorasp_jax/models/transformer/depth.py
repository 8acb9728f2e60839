"""Stacks of identical layers, applied with `lax.scan` or unrolled."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.dense import AdapterParam
from lorasp_jax.kernels.rematerialization import save_narrow_products, save_products
from lorasp_jax.models.config import Remat

_REMAT_POLICIES = {"products": save_products, "narrow": save_narrow_products, "full": None}

Block = TypeVar("Block", bound=nnx.Module)


def stack(make: Callable[[nnx.Rngs], Block], depth: int, rngs: nnx.Rngs) -> Block:
    """Initialize L = `depth` blocks as one module whose parameters have a leading axis L."""
    keys = jax.random.split(rngs.params(), depth)
    return jax.vmap(lambda key: make(nnx.Rngs(params=key)))(keys)


def scan_depth(
    blocks: Block,
    call: Callable[[Block, jax.Array, Any], tuple[jax.Array, Any]],
    x: jax.Array,
    per_layer: Any = None,
    *,
    remat: Remat = "none",
    unroll: bool = False,
) -> tuple[jax.Array, Any]:
    """Apply stacked blocks to x.

    Args:
        blocks: from `stack` or `unstack`.
        call: (block, x, the layer's slice of `per_layer`) -> (x, per-layer output).
        x: `[B, T, D]`.
        per_layer: pytree of arrays with a leading axis L, or None. With `unstack`ed blocks, any
            part of it may be a `ByLayer`.
        remat: rematerialization policy; see `BackboneConfig.remat`.
        unroll: unroll the loop over layers instead of using `lax.scan`.

    Returns:
        `[B, T, D]`, and the per-layer outputs stacked to `[L, ...]`.
    """
    unstacked = isinstance(blocks, nnx.List)
    graphdef, *state = nnx.split(blocks[0] if unstacked else blocks, AdapterParam, ...)

    def layer(x: jax.Array, scanned: tuple[Any, Any]) -> tuple[jax.Array, Any]:
        params, inputs = scanned
        arrays = params.materialize() if isinstance(params, _LayerSlice) else params
        block: Any = nnx.merge(graphdef, *arrays)
        return call(block, x, inputs)

    if remat != "none":
        layer = jax.checkpoint(layer, prevent_cse=unroll, policy=_REMAT_POLICIES[remat])
    if not unstacked and not unroll:
        return jax.lax.scan(layer, x, (state, per_layer))
    layer_params = (
        [nnx.state(block, AdapterParam, ...) for block in blocks]
        if unstacked
        else _lazy_slices(*state)
    )
    layer_inputs = [None] * len(layer_params) if per_layer is None else _by_layer(per_layer)
    layer, outputs = jax.jit(layer, inline=True), []  # trace the layer once
    for params, inputs in zip(layer_params, layer_inputs, strict=True):
        x, output = layer(x, (params, inputs))
        outputs.append(output)
    return x, jax.tree.map(lambda *layers: jnp.stack(layers), *outputs)


class ByLayer(NamedTuple):
    """Inputs of each layer, for a loop around `scan_depth` that slices nothing."""

    layers: list[Any]

    @classmethod
    def of(cls, stacked: Any) -> "ByLayer":
        """Split arrays with a leading axis L."""
        return cls(_split_layers(stacked))


def _by_layer(inputs: Any) -> list[Any]:
    """Split inputs into those of each layer."""
    parts, structure = jax.tree.flatten(inputs, is_leaf=lambda node: isinstance(node, ByLayer))
    split = [part.layers if isinstance(part, ByLayer) else _split_layers(part) for part in parts]
    return [jax.tree.unflatten(structure, layer) for layer in zip(*split, strict=True)]


def _split_layers(stacked: Any) -> list[Any]:
    """Split arrays [L, ...] into layers, so that the backward pass concatenates their gradients.

    With indexing, the backward pass would add L zero-padded gradients.
    """
    leaves, structure = jax.tree.flatten(stacked)
    slices = zip(*(jax.lax.split(leaf, [1] * len(leaf)) for leaf in leaves), strict=True)
    return [
        jax.tree.unflatten(structure, [jax.lax.squeeze(array, [0]) for array in layer])
        for layer in slices
    ]


class _LayerSlice(NamedTuple):
    """Lazy slice of one layer from stacked arrays.

    Under `jax.checkpoint`, the backward pass slices again, so no slices are saved.
    """

    trained: Any
    """Stacked trainable arrays [L, ...]."""
    frozen: Any
    """Stacked frozen arrays [L, ...]."""
    index: np.int32
    gradient_sinks: Any
    """The layer's slices of `trained`. They receive the gradients; their values are unused."""

    def materialize(self) -> tuple[Any, Any]:
        """Return the layer's trainable and frozen arrays [...]."""
        trained = jax.tree.map(
            lambda stack, sink: _slice_with_gradient(stack, self.index, sink),
            self.trained,
            self.gradient_sinks,
        )
        return trained, jax.tree.map(lambda stack: _slice(stack, self.index), self.frozen)


def _slice(stack: jax.Array, index: np.int32) -> jax.Array:
    return jax.lax.dynamic_index_in_dim(stack, index, keepdims=False)


@jax.custom_jvp
def _slice_with_gradient(stack: jax.Array, index: np.int32, sink: jax.Array) -> jax.Array:
    """Return stack[index], with its gradient flowing to `sink`, which has the same value."""
    del sink
    return _slice(stack, index)


@_slice_with_gradient.defjvp
def _(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    return _slice(*primals[:2]), tangents[2]


def _lazy_slices(trained: Any, frozen: Any) -> list[_LayerSlice]:
    """Slice arrays [L, ...] lazily, one slice per layer."""
    depth = len(jax.tree.leaves((trained, frozen))[0])
    sinks = _split_layers(trained) or [trained] * depth  # no slices if no array is trainable
    return [_LayerSlice(trained, frozen, np.int32(i), sink) for i, sink in enumerate(sinks)]


def unstack(blocks: nnx.Module) -> nnx.List[Any]:
    """Split stacked blocks into a list, so that a loop around `scan_depth` slices no weights."""
    graphdef, state = nnx.split(blocks)
    return nnx.List([nnx.merge(graphdef, layer) for layer in _split_layers(state)])
