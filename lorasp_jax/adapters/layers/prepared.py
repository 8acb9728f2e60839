"""Adapted layers made ready for inference: what does not depend on the input is computed once.

A layer that is called again and again on a few tokens, as in the steps of a flow, is as fast as its
kernels are few. So layers that read one input get one matrix for all that reads it and one for all
that adapters write:

    [x W, x P] = x [W, P]         for the W and P of all layers
    y = x W + z diag(U)           with z = f(x P)

Their chains f between the matrices run as one. Stacked layers that are called once, as those that
read the pictures, get P and U alone, in the type in which they compute: a copy of W would cost more
than it saves. The layers themselves go. For training there is `lorasp_jax.kernels.low_rank_matmul`.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import (
    Any,
    Literal,
    NamedTuple,
    Protocol,
    TypeAlias,
    TypeGuard,
    TypeVar,
    runtime_checkable,
)

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.dense import Dense
from lorasp_jax.kernels.low_rank_matmul import base_plus_low_rank, pad_columns
from lorasp_jax.kernels.quantized_weights import QuantizedKernel
from lorasp_jax.peft import Aux
from lorasp_jax.peft._batched_bottleneck import BatchedBottleneck, VmapBottleneck

Block = TypeVar("Block", bound="JoinsLayers")

TILE, PROGRAMS = 64, 256
"""Side of the tiles of a product's result, and how many of them at once keep a GPU busy."""
LONG_SUM, SHORTEST_SUM = 2048, 512
"""Inputs from which on a product is worth parts, and the least to a part."""


class Chain(NamedTuple):
    """f of n layers."""

    method: BatchedBottleneck
    width: int
    """Q, the columns of P of one layer."""
    sizes: tuple[int, ...]
    """O of each layer."""


_pytree = functools.partial(jax.tree_util.register_dataclass, meta_fields=["chain"])


@functools.partial(_pytree, data_fields=["params", "read", "write", "bias"])
@dataclasses.dataclass(frozen=True)
class Joined:
    """Layers of one method that read the same input."""

    chain: Chain
    params: Any
    """What f needs of the adapters of the n layers, [n, ...]; None where shapes differ."""
    read: jax.Array
    """[W, P], [I, sum of O and of Q or a little more]."""
    write: jax.Array
    """Each layer's U [R, O] on the diagonal, [n R, sum of O]."""
    bias: jax.Array | None
    """[sum of O], None if no layer has one."""


@functools.partial(_pytree, data_fields=["params", "read", "write", "kernels", "biases"])
@dataclasses.dataclass(frozen=True)
class Apart:
    """The same for layers whose W are read where they are."""

    chain: Chain
    params: Any
    """As in `Joined`."""
    read: jax.Array
    """P of all layers, [I, sum of Q or a little more]."""
    write: list[jax.Array]
    """U [R, O] of each layer."""
    kernels: list[jax.Array | QuantizedKernel]
    """W [I, O] of each layer; a quantised one stays so."""
    biases: list[jax.Array | None]
    """[O] of each layer."""


class Ready(nnx.Variable[Any]):
    """`Joined` or `Apart`."""


class Prepared(nnx.Module):
    """Joined layers in the place of the first of them; the others' places hold an empty one."""

    def __init__(self, arrays: Joined | Apart | None = None) -> None:
        self.ready = None if arrays is None else Ready(arrays)

    def __call__(
        self, x: jax.Array, *, token_mask: jax.Array | None, return_aux: Literal[True]
    ) -> tuple[jax.Array, Aux]:
        """y `[..., O]` and aux of the only layer."""
        del return_aux
        (result,) = self.results(x, token_mask)
        return result

    def results(self, x: jax.Array, token_mask: jax.Array | None) -> list[tuple[jax.Array, Aux]]:
        """y and aux of each of the layers for x `[..., I]`; none if it is empty."""
        if self.ready is None:
            return []
        joined = self.ready.get_value()
        compute: Callable = _call_joined if isinstance(joined, Joined) else _call_apart
        ys, aux = compute(joined, x.astype(joined.read.dtype), token_mask)
        of_each = [jax.tree.map(lambda a, i=i: a[i], aux) for i in range(len(ys))]
        reports = [dataclasses.replace(one, token_mask=token_mask) for one in of_each]
        return list(zip(ys, reports, strict=True))


Layer: TypeAlias = Dense | Prepared
"""What stands where a `Dense` was."""


@runtime_checkable
class JoinsLayers(Protocol):
    """A module that knows which of its layers read the same input."""

    def join_layers(self, *, copy_kernels: bool = True) -> None:
        """Puts joined layers in the place of its own, children's left out; see `join`."""
        ...


def join(layers: Sequence[Layer], *, copy_kernels: bool = True) -> list[Layer]:
    """What takes the places of layers that read the same input.

    Layers of the kind `Dense` with a type of their own are joined, if their method is x W + z U:
    all of them, or each by itself where they differ in method or type. The others stay.

    Args:
        layers: in the order in which they are called together.
        copy_kernels: for layers that are called again and again.
    """
    can = [layer for layer in layers if _can_join(layer)]
    arrays = _join if copy_kernels else _apart
    if len(can) == len(layers) and len({(layer.method, layer.dtype) for layer in can}) == 1:
        return [Prepared(arrays(can)), *(Prepared() for _ in can[1:])]
    return [Prepared(arrays([layer])) if _can_join(layer) else layer for layer in layers]


def join_one(layer: Layer, *, copy_kernels: bool = True) -> Layer:
    """`join` for a layer whose input no other reads."""
    return join([layer], copy_kernels=copy_kernels)[0]


def join_stack(blocks: Block) -> Block:
    """Stacked blocks [L, ...] for one run through them, adapters' matrices cast all at once."""

    def joined(block: Block) -> Block:
        block.join_layers(copy_kernels=False)
        return block

    return jax.vmap(joined)(blocks)


def _call_joined(
    joined: Joined, x: jax.Array, token_mask: jax.Array | None
) -> tuple[Sequence[jax.Array], Aux]:
    """y of each layer, and aux [n, ...]."""
    ends = list(itertools.accumulate(joined.chain.sizes))
    projected = product(x, joined.read)
    z, aux = _bottleneck(joined, projected, ends[-1], token_mask)
    y = projected[..., : ends[-1]] + z @ joined.write
    y = y if joined.bias is None else y + joined.bias
    return jnp.split(y, ends[:-1], axis=-1), aux


def _call_apart(
    apart: Apart, x: jax.Array, token_mask: jax.Array | None
) -> tuple[Sequence[jax.Array], Aux]:
    """What `_call_joined` returns."""
    # XLA would make one product of x W and x P, for which it copies W.
    projected = product(jax.lax.optimization_barrier(x), apart.read)
    z, aux = _bottleneck(apart, projected, 0, token_mask)
    ys, zs = [], jnp.split(z, len(apart.write), axis=-1)
    for own, kernel, up, bias in zip(zs, apart.kernels, apart.write, apart.biases, strict=True):
        y = base_plus_low_rank(x, own, kernel, up)
        ys.append(y if bias is None else y + bias)
    return ys, aux


def _bottleneck(
    ready: Joined | Apart, projected: jax.Array, start: int, token_mask: jax.Array | None
) -> tuple[jax.Array, Aux]:
    """Concatenated z of all layers, in the dtype of `projected`, and aux."""
    method, width, sizes = ready.chain
    columns = range(start, start + len(sizes) * width, width)
    z, aux = method.bottleneck_all(ready.params, projected, columns, token_mask)
    return z.astype(projected.dtype), aux


def product(x: jax.Array, matrix: jax.Array) -> jax.Array:
    """x @ matrix in the type of x, as a sum over parts where that fills a GPU better.

    A GPU computes tiles of the result side by side, and each sums over all inputs one after the
    other. A few rows times a narrow matrix with a long sum keep few of its processors busy.

    Args:
      x: [..., I].
      matrix: [I, O].
    """
    d_in, d_out = matrix.shape
    parts = _parts(math.prod(x.shape[:-1]), d_in, d_out)
    if parts == 1:
        return x @ matrix
    x = x.reshape(*x.shape[:-1], parts, d_in // parts)
    matrix = matrix.reshape(parts, d_in // parts, d_out)
    wide = jnp.einsum("...pi,pio->p...o", x, matrix, preferred_element_type=jnp.float32)
    return wide.sum(0).astype(x.dtype)


def _parts(rows: int, d_in: int, d_out: int) -> int:
    """How many parts [rows, I] @ [I, O] is best summed over: a power of two that divides I."""
    tiles = math.ceil(rows / TILE) * math.ceil(d_out / TILE)
    parts = 1
    while 2 * parts * tiles <= PROGRAMS and d_in % (2 * parts * SHORTEST_SUM) == 0:
        parts *= 2
    return parts if d_in >= LONG_SUM else 1


def _can_join(layer: Layer) -> TypeGuard[Dense]:
    """Whether it is an adapted layer, not a stack, of a method that leaves `apply` as it is."""
    if type(layer) is not Dense or layer.adapter is None or layer.dtype is None:
        return False
    method, _ = layer.method_and_params()
    can_join = method.is_low_rank_sum and not method.down_in_fp32
    return can_join and len(layer.kernel_matrices().shape) == 2  # a quantised one has no ndim


def _matrices(
    layers: Sequence[Dense],
) -> tuple[list[jax.Array], list[jax.Array], list[jax.Array], list[jax.Array | None]]:
    """W, P, U and bias of each layer, in the type in which they compute."""
    method, _ = layers[0].method_and_params()
    params, dtype = [layer.method_and_params()[1] for layer in layers], layers[0].dtype
    biases = [None if layer.bias is None else layer.bias.get_value() for layer in layers]
    return (
        [layer.kernel_matrices().astype(dtype) for layer in layers],
        [method.down(p).astype(dtype) for p in params],
        [method.up(p).astype(dtype) for p in params],
        [None if bias is None else bias.astype(dtype) for bias in biases],
    )


def _chain(layers: Sequence[Dense], downs: Sequence[jax.Array]) -> tuple[Chain, Any]:
    """f, and what it needs, [n, ...]; None where shapes differ."""
    carried = [layer.method_and_params() for layer in layers]
    kernels = {method.fused_kernel(params) or VmapBottleneck(method) for method, params in carried}
    bottleneck = kernels.pop() if len(kernels) == 1 else VmapBottleneck(carried[0][0])

    def stacked(*leaves: jax.Array) -> jax.Array | None:
        return jnp.stack(leaves) if len({leaf.shape for leaf in leaves}) == 1 else None

    packed = (bottleneck.pack(method.bottleneck_params(params)) for method, params in carried)
    params = jax.tree.map(stacked, *packed)
    sizes = tuple(layer.kernel_matrices().shape[1] for layer in layers)
    return Chain(bottleneck, downs[0].shape[1], sizes), params


def _apart(layers: Sequence[Dense]) -> Apart:
    wide, downs, ups, biases = _matrices(layers)
    own = [layer.kernel_matrices() for layer in layers]
    kernels = [k if isinstance(k, QuantizedKernel) else w for k, w in zip(own, wide, strict=True)]
    read = pad_columns(jnp.concatenate(downs, axis=1))
    return Apart(*_chain(layers, downs), read, ups, kernels, biases)


def _join(layers: Sequence[Dense]) -> Joined:
    kernels, downs, ups, biases = _matrices(layers)
    filled = [
        jnp.zeros(kernel.shape[1], kernel.dtype) if bias is None else bias
        for kernel, bias in zip(kernels, biases, strict=True)
    ]
    has_bias = any(bias is not None for bias in biases)
    return Joined(
        *_chain(layers, downs),
        read=pad_columns(jnp.concatenate(kernels + downs, axis=1)),
        write=jax.scipy.linalg.block_diag(*ups),
        bias=jnp.concatenate(filled) if has_bias else None,
    )
