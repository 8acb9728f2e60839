"""Adapted layers made ready for inference: what does not depend on the input is computed once.

A layer that is called again and again on a few tokens, as in the steps of a flow, is as fast as its
kernels are few. So layers that read one input get one matrix for all that reads it and one for all
that adapters write:

    [x W, x P] = x [W, P]         for the W and P of all layers
    y = x W + z diag(U)           with z = f(x P)

Their chains f between the matrices run as one. Stacked layers that are called once, as those that
read the pictures, get P and U alone, in the type in which they compute: a copy of W would cost more
than it saves. For training there is `lorasp_jax.kernels.low_rank_matmul`.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.dense import Dense
from lorasp_jax.kernels.low_rank_matmul import aligned, two_products
from lorasp_jax.peft import Aux, Method

Names = tuple[str, ...]
Block = TypeVar("Block", bound=nnx.Module)

TILE, PROGRAMS = 64, 256
"""Side of the tiles of a product's result, and how many of them at once keep a GPU busy."""
LONG_SUM, SHORTEST_SUM = 2048, 512
"""Inputs from which on a product is worth parts, and the least to a part."""


class Joined(NamedTuple):
    """Layers of one method that read the same input."""

    params: Any
    """What f needs of the adapters of the n layers, [n, ...]; None where shapes differ."""
    read: jax.Array
    """[W, P], [I, sum of O and of Q or a little more]."""
    write: jax.Array
    """Each layer's U [R, O] on the diagonal, [n R, sum of O]."""
    bias: jax.Array | None
    """[sum of O], None if no layer has one."""


class Apart(NamedTuple):
    """The same for layers whose W are read where they are."""

    params: Any
    """As in `Joined`."""
    read: jax.Array
    """P of all layers, [I, sum of Q or a little more]."""
    write: list[jax.Array]
    """U [R, O] of each layer."""


class Ready(nnx.Variable):
    """What `prepare` leaves in a module: `Joined` or `Apart` by the names of the layers."""


def prepare(module: nnx.Module, *, copy_kernels: bool = True) -> None:
    """Joins the adapted layers that are attributes of the module; it then computes the same.

    `module.together`, if there is one, names layers that read the same input. Layers of the kind
    `Dense` with a type of their own are joined, if their method is x W + z U; the others stay.
    `copy_kernels` is for modules that are called again and again.
    """
    layers = {name: layer for name, layer in vars(module).items() if _can_join(layer)}
    groups = [names for names in getattr(module, "together", ()) if _one_kind(layers, names)]
    grouped = {name for names in groups for name in names}
    groups += [(name,) for name in layers if name not in grouped]
    if groups:
        join = _join if copy_kernels else _cast
        joined = {names: join([layers[name] for name in names]) for names in groups}
        module.ready = Ready(joined)  # pyright: ignore[reportAttributeAccessIssue]


def prepared_stack(blocks: Block) -> Block:
    """Stacked blocks [L, ...] for one run through them, adapters' matrices cast all at once."""

    def prepared(block: Block) -> Block:
        prepare(block, copy_kernels=False)
        return block

    return jax.vmap(prepared)(blocks)


def call(
    module: nnx.Module, names: Names, x: jax.Array, token_mask: jax.Array | None
) -> list[tuple[jax.Array, Aux]] | None:
    """y and aux of each layer for the same x `[..., I]`, or None if they are not joined."""
    ready = getattr(module, "ready", None)
    if ready is None or names not in ready.get_value():
        return None
    layers: list[Dense] = [getattr(module, name) for name in names]
    compute = _call_joined if isinstance(ready.get_value()[names], Joined) else _call_apart
    ys, aux = compute(ready.get_value()[names], layers, layers[0].as_input(x), token_mask)
    of_each = [jax.tree.map(lambda a, i=i: a[i], aux) for i in range(len(names))]
    reports = [dataclasses.replace(one, token_mask=token_mask) for one in of_each]
    return list(zip(ys, reports, strict=True))


def _call_joined(
    joined: Joined, layers: Sequence[Dense], x: jax.Array, token_mask: jax.Array | None
) -> tuple[Sequence[jax.Array], Aux]:
    """y of each layer, and aux [n, ...]."""
    ends = list(itertools.accumulate(map(_outputs, layers)))
    read = product(x, joined.read)
    z, aux = _between(joined, layers, read, ends[-1], token_mask)
    y = read[..., : ends[-1]] + z @ joined.write
    y = y if joined.bias is None else y + joined.bias
    return jnp.split(y, ends[:-1], axis=-1), aux


def _call_apart(
    apart: Apart, layers: Sequence[Dense], x: jax.Array, token_mask: jax.Array | None
) -> tuple[Sequence[jax.Array], Aux]:
    """What `_call_joined` returns."""
    # XLA would make one product of x W and x P, for which it copies W.
    read = product(jax.lax.optimization_barrier(x), apart.read)
    z, aux = _between(apart, layers, read, 0, token_mask)
    ys = []
    for layer, own, up in zip(layers, jnp.split(z, len(layers), axis=-1), apart.write, strict=True):
        y = two_products(x, own, layer.kernel_matrices().astype(x.dtype), up)
        ys.append(y if layer.bias is None else y + layer.bias.get_value().astype(y.dtype))
    return ys, aux


def _between(
    ready: Joined | Apart,
    layers: Sequence[Dense],
    read: jax.Array,
    start: int,
    token_mask: jax.Array | None,
) -> tuple[jax.Array, Aux]:
    """z of all layers side by side, in the type of `read`, whose rows begin at a column; aux."""
    method, _ = layers[0].carried()
    width = _rows(layers[0])
    columns = range(start, start + len(layers) * width, width)
    z, aux = method.between_all(ready.params, read, columns, token_mask)
    return z.astype(read.dtype), aux


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


def _can_join(layer: Any) -> bool:
    """Whether it is an adapted layer, not a stack, of a method that leaves `apply` as it is."""
    if type(layer) is not Dense or layer.adapter is None or layer.dtype is None:
        return False
    method, _ = layer.carried()
    plain = type(method).apply is Method.apply and not method.reads_in_fp32
    return plain and len(layer.kernel_matrices().shape) == 2  # a quantised one has no ndim


def _one_kind(layers: dict[str, Dense], names: Names) -> bool:
    """Whether all of these are there, with one method and type."""
    found = [layers[name] for name in names if name in layers]
    return len(found) == len(names) and len({(a.method, a.dtype) for a in found}) == 1


def _rows(layer: Dense) -> int:
    """Q, the width of P."""
    method, params = layer.carried()
    return jax.eval_shape(method.down, params).shape[1]


def _outputs(layer: Dense) -> int:
    """O."""
    return layer.kernel_matrices().shape[1]


def _matrices(layers: Sequence[Dense]) -> tuple[list[jax.Array], list[jax.Array]]:
    """P and U of each layer, in the type in which they compute."""
    method, _ = layers[0].carried()
    params, dtype = [layer.carried()[1] for layer in layers], layers[0].dtype
    return (
        [method.down(p).astype(dtype) for p in params],
        [method.up(p).astype(dtype) for p in params],
    )


def _cast(layers: Sequence[Dense]) -> Apart:
    downs, ups = _matrices(layers)
    return Apart(_params(layers), aligned(jnp.concatenate(downs, axis=1)), ups)


def _params(layers: Sequence[Dense]) -> Any:
    """What f needs, [n, ...]; None where shapes differ."""
    method, _ = layers[0].carried()

    def stacked(*leaves: jax.Array) -> jax.Array | None:
        return jnp.stack(leaves) if len({leaf.shape for leaf in leaves}) == 1 else None

    return jax.tree.map(stacked, *(method.for_rows(layer.carried()[1]) for layer in layers))


def _join(layers: Sequence[Dense]) -> Joined:
    downs, ups = _matrices(layers)
    dtype = layers[0].dtype
    kernels = [layer.kernel_matrices().astype(dtype) for layer in layers]
    biases = [
        jnp.zeros(_outputs(layer), dtype) if layer.bias is None else layer.bias.get_value()
        for layer in layers
    ]
    has_bias = any(layer.bias is not None for layer in layers)
    return Joined(
        params=_params(layers),
        read=aligned(jnp.concatenate(kernels + downs, axis=1)),
        write=jax.scipy.linalg.block_diag(*ups),
        bias=jnp.concatenate(biases).astype(dtype) if has_bias else None,
    )
