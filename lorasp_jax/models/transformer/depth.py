"""Stacks of equal layers and how x runs through them: in a loop or in straight-line code."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.ad_checkpoint import checkpoint_name

from lorasp_jax.dense import AdapterParam
from lorasp_jax.models.config import Remat

_SLOW_TO_REPEAT = ("dot_product_attention_fwd_wrapper", "custom_vmap_call")
"""Primitives of cuDNN's attention and of the adapters' kernel (`kernels.row_sharding`)."""
_NAMED = "stored"


def stored(x: jax.Array) -> jax.Array:
    """x, which a layer stores for its backward pass instead of the products it was made of."""
    return checkpoint_name(x, _NAMED)


def _keep_products(primitive: Any, *shapes: Any, **params: Any) -> Any:
    """Results of matrix products are stored, what is slow to repeat, and what has a name."""
    if primitive.name in _SLOW_TO_REPEAT or params.get("name") == _NAMED:
        return True
    return jax.checkpoint_policies.dots_with_no_batch_dims_saveable(primitive, *shapes, **params)


_KEPT = {"products": _keep_products, "full": None}

Block = TypeVar("Block", bound=nnx.Module)


def stack(make: Callable[[nnx.Rngs], Block], depth: int, rngs: nnx.Rngs) -> Block:
    """`depth` independently drawn blocks as one module whose parameters have a leading axis L."""
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
    """Run x through stacked blocks.

    Args:
        blocks: from `stack` or `unstacked`.
        call: (block, x, its slice of `per_layer`) -> (x, what to keep).
        x: `[B, T, D]`.
        per_layer: pytree with a leading axis L, or None.
        remat: what of a block is computed again in the backward pass instead of stored.
        unroll: straight-line code instead of a loop.

    Returns:
        `[B, T, D]`, and what the blocks gave to keep, stacked to `[L, ...]`.
    """
    one_by_one = isinstance(blocks, nnx.List)
    graphdef, *state = nnx.split(blocks[0] if one_by_one else blocks, AdapterParam, ...)

    def layer(x: jax.Array, scanned: tuple[Any, Any]) -> tuple[jax.Array, Any]:
        own, other = scanned
        block: Any = nnx.merge(graphdef, *(own.taken() if isinstance(own, _Part) else own))
        return call(block, x, other)

    if remat != "none":
        layer = jax.checkpoint(layer, prevent_cse=unroll, policy=_KEPT[remat])
    if not one_by_one and not unroll:
        return jax.lax.scan(layer, x, (state, per_layer))
    states = (
        [nnx.state(block, AdapterParam, ...) for block in blocks]
        if one_by_one
        else _parts_of(*state)
    )
    others = [None] * len(states) if per_layer is None else _layers_of(per_layer)
    layer, kept = jax.jit(layer, inline=True), []  # traced once
    for own, other in zip(states, others, strict=True):
        x, keep = layer(x, (own, other))
        kept.append(keep)
    return x, jax.tree.map(lambda *layers: jnp.stack(layers), *kept)


def _layers_of(stacked: Any) -> list[Any]:
    """Each layer's part of arrays [L, ...]; their gradients are stacked, not added up."""
    leaves, structure = jax.tree.flatten(stacked)
    parts = zip(*(jax.lax.split(leaf, [1] * len(leaf)) for leaf in leaves), strict=True)
    return [
        jax.tree.unflatten(structure, [jax.lax.squeeze(part, [0]) for part in layer])
        for layer in parts
    ]


class _Part(NamedTuple):
    """One layer's part of a stack, taken where it is needed.

    Within `jax.checkpoint` the backward pass then takes it again from the stack, which is there
    anyway, instead of keeping every layer's part from the forward pass on.
    """

    trained: Any
    """Stacked arrays [L, ...]."""
    frozen: Any
    """The same."""
    index: np.int32
    gradients: Any
    """The layer's part of `trained`: not read, but where its gradient goes."""

    def taken(self) -> tuple[Any, Any]:
        """The layer's arrays [...], trained and frozen."""
        trained = jax.tree.map(
            lambda stack, own: _taken(stack, self.index, own), self.trained, self.gradients
        )
        return trained, jax.tree.map(lambda stack: _at(stack, self.index), self.frozen)


def _at(stack: jax.Array, index: np.int32) -> jax.Array:
    return jax.lax.dynamic_index_in_dim(stack, index, keepdims=False)


@jax.custom_jvp
def _taken(stack: jax.Array, index: np.int32, own: jax.Array) -> jax.Array:
    """stack[index], which `own` is too; its gradient is that of `own`."""
    del own
    return _at(stack, index)


@_taken.defjvp
def _(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    return _at(*primals[:2]), tangents[2]


def _parts_of(trained: Any, frozen: Any) -> list[_Part]:
    """Each layer's part of arrays [L, ...]."""
    depth = len(jax.tree.leaves((trained, frozen))[0])
    gradients = _layers_of(trained) or [trained] * depth  # nothing may train
    return [_Part(trained, frozen, np.int32(i), own) for i, own in enumerate(gradients)]


def unstacked(blocks: nnx.Module) -> nnx.List[Any]:
    """Stacked blocks one by one: a loop around them then slices no weights."""
    graphdef, state = nnx.split(blocks)
    return nnx.List([nnx.merge(graphdef, layer) for layer in _layers_of(state)])
