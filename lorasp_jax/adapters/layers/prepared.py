"""Adapted layers prepared for inference: precompute whatever does not depend on the input.

A layer with kernel W, down-projection P and up-projection U computes y = x W + f(x P) U. When
layers are called repeatedly on few tokens, as in flow sampling, GPU kernel launches dominate the
time. Layers with a shared input are therefore fused into one input and one output matrix:

    [x W, x P] = x [W, P]         W and P of all layers, concatenated
    y = x W + z diag(U)           with z = f(x P), and diag(U) block-diagonal

The functions f of all layers run as one GPU kernel if their method has one. Layers without adapters
and with a shared input become one matmul, x [W1, W2, ...]. The original layers are removed.

Very wide layers compute y = [x, z] [W; U] instead: another pass over y would cost more than a
second matmul with x. Where copying W would cost more than it saves, as in a sampler that is used
once, or where W is quantized, only the P are concatenated, and P and U are cast to the compute
dtype. For training, see `lorasp_jax.kernels.low_rank_matmul`.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, TypeAlias, TypeGuard, TypeVar

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.dense import Dense
from lorasp_jax.kernels.low_rank_matmul import (
    Bottleneck,
    Mask,
    base_plus_low_rank,
    pad_columns,
)
from lorasp_jax.kernels.quantized_weights import QuantizedKernel
from lorasp_jax.peft import Aux

Block = TypeVar("Block", bound=nnx.Module)

TILE, MIN_TILES = 64, 256
"""Output tile size of a matmul, and the number of tiles that saturate a GPU."""
MIN_SPLIT_INPUTS, MIN_SPLIT_SIZE = 2048, 512
"""Minimum I for a split-K matmul, and minimum K per split."""
MAX_FUSED_OUTPUTS = 16384
"""Maximum ΣO of `FusedLayers`. With 32,768, as in gate and up of pi0's language model, the layers
take about 190 us as `SharedProjection` instead of 225 (816 tokens, LoRA-SP with R = 128, H200)."""


class BottleneckSpec(NamedTuple):
    """The function f of n layers."""

    f: Bottleneck
    width: int
    """Q, the number of columns of one layer's P."""
    out_sizes: tuple[int, ...]
    """O of each layer."""


_pytree = functools.partial(jax.tree_util.register_dataclass, meta_fields=["bottleneck"])


@functools.partial(_pytree, data_fields=["params", "input_matrix", "output_matrix", "bias"])
@dataclasses.dataclass(frozen=True)
class FusedLayers:
    """Fused layers with the same method and a shared input."""

    bottleneck: BottleneckSpec
    params: Any
    """Parameters of f, stacked [n, ...]; a leaf is None if its shape differs between layers."""
    input_matrix: jax.Array
    """[W, P], [I, ΣO + ΣQ], padded."""
    output_matrix: jax.Array
    """Block-diagonal matrix of each layer's U [R, O], [n R, ΣO]."""
    bias: jax.Array | None
    """[ΣO], or None if no layer has a bias."""


@functools.partial(_pytree, data_fields=["params", "down", "ups", "kernels", "biases"])
@dataclasses.dataclass(frozen=True)
class SharedProjection:
    """Like `FusedLayers`, but only the layers' P are one matrix."""

    bottleneck: BottleneckSpec
    params: Any
    """As in `FusedLayers`."""
    down: jax.Array
    """P of all layers, [I, ΣQ], padded."""
    ups: Sequence[jax.Array | None]
    """U [R, O] of each layer, or None if it is in `kernels`."""
    kernels: Sequence[jax.Array | QuantizedKernel]
    """W [I, O] of each layer, kept quantized, or [W; U] [I + R, O], padded."""
    biases: list[jax.Array | None]
    """[O] of each layer."""


@functools.partial(
    jax.tree_util.register_dataclass, data_fields=["kernel", "bias"], meta_fields=["out_sizes"]
)
@dataclasses.dataclass(frozen=True)
class FusedKernels:
    """Fused layers without adapters."""

    kernel: jax.Array
    """W of all layers, [I, ΣO]."""
    bias: jax.Array | None
    """[ΣO], or None if no layer has a bias."""
    out_sizes: tuple[int, ...]
    """O of each layer."""


class FusedArrays(nnx.Variable[Any]):
    """Variable that holds `FusedLayers`, `SharedProjection` or `FusedKernels`."""


class Prepared(nnx.Module):
    """Fused layers, stored in place of the first layer; empty instances replace the others."""

    def __init__(self, arrays: FusedLayers | SharedProjection | FusedKernels | None = None) -> None:
        self.fused = None if arrays is None else FusedArrays(arrays)

    def __call__(
        self, x: jax.Array, *, token_mask: Mask, return_aux: Literal[True]
    ) -> tuple[jax.Array, Aux]:
        """Compute y `[..., O]` and aux, for a `Prepared` with exactly one layer."""
        del return_aux
        (result,) = self.results(x, token_mask)
        return result

    def results(self, x: jax.Array, token_mask: Mask) -> list[tuple[jax.Array, Aux]]:
        """Compute y and aux of each layer for x `[..., I]`; an empty instance returns []."""
        if self.fused is None:
            return []
        fused = self.fused.get_value()
        if isinstance(fused, FusedKernels):
            return [(y, Aux()) for y in _call_kernels(fused, x.astype(fused.kernel.dtype))]
        if isinstance(fused, FusedLayers):
            ys, aux = _call_fused(fused, x.astype(fused.input_matrix.dtype), token_mask)
        else:
            ys, aux = _call_shared(fused, x.astype(fused.down.dtype), token_mask)
        per_layer = [jax.tree.map(lambda a, i=i: a[i], aux) for i in range(len(ys))]
        reports = [dataclasses.replace(layer_aux, token_mask=token_mask) for layer_aux in per_layer]
        return list(zip(ys, reports, strict=True))


Layer: TypeAlias = Dense | Prepared
"""A `Dense` or its prepared replacement."""


def fuse_projections(module: nnx.Module, *, copy_kernels: bool = True) -> None:
    """Fuse a module's own `Dense` layers in place, not its children's; see `fuse_layers`.

    Its class lists the names of layers with a shared input in `shared_inputs`, in call order.
    """
    groups = [*getattr(module, "shared_inputs", ())]
    shared = {name for group in groups for name in group}
    layers = [name for name, value in vars(module).items() if type(value) is Dense]
    for names in (*groups, *((name,) for name in layers if name not in shared)):
        own = [getattr(module, name) for name in names]
        for name, layer in zip(names, fuse_layers(own, copy_kernels=copy_kernels), strict=True):
            setattr(module, name, layer)


def fuse_layers(layers: Sequence[Layer], *, copy_kernels: bool = True) -> list[Layer]:
    """Return replacements for layers with a shared input.

    A single (unstacked) adapted `Dense` can be fused if it has an explicit dtype, and its method
    computes exactly x W + z U and does not need x P in fp32. If all layers can be fused and agree
    on method and dtype, they are fused together. Otherwise each fusable layer is fused alone, and
    the others are returned unchanged. Several layers without adapters are fused if W may be copied
    and all have the same explicit dtype.

    Args:
        layers: layers in call order.
        copy_kernels: whether to copy W, unless one is quantized; best unless the fused layers are
            called once.
    """
    # A concatenated W would have to be dequantized, which is what quantization saves.
    copy_kernels = copy_kernels and not any(map(_is_quantized, layers))
    plain = [layer for layer in layers if _is_plain(layer)]
    # Without adapters, one matmul of all W. A single such layer would gain nothing.
    same = len(plain) == len(layers) and len({layer.dtype for layer in plain}) == 1
    if copy_kernels and len(layers) > 1 and same:
        return [Prepared(_fused_kernels(plain)), *(Prepared() for _ in plain[1:])]
    # One f for all layers needs one method, and one matmul needs one dtype.
    fusable = [layer for layer in layers if _is_fusable(layer)]
    fuse = _with_copied_kernels if copy_kernels else _shared_projection
    if len(fusable) == len(layers) and len({(layer.method, layer.dtype) for layer in fusable}) == 1:
        return [Prepared(fuse(fusable)), *(Prepared() for _ in fusable[1:])]
    return [Prepared(fuse([layer])) if _is_fusable(layer) else layer for layer in layers]


def fuse_stack(blocks: Block) -> Block:
    """Prepare stacked modules [L, ...] without copying their kernels."""

    def fuse(block: Block) -> Block:
        fuse_projections(block, copy_kernels=False)
        return block

    return jax.vmap(fuse)(blocks)


def _call_fused(
    fused: FusedLayers, x: jax.Array, token_mask: Mask
) -> tuple[Sequence[jax.Array], Aux]:
    """Output y of each layer, and aux with leading axis n."""
    ends = list(itertools.accumulate(fused.bottleneck.out_sizes))
    projected = matmul(x, fused.input_matrix)
    # x P follows x W in the same array, where f reads it.
    z, aux = _bottleneck(fused, projected, ends[-1], token_mask)
    y = projected[..., : ends[-1]] + z @ fused.output_matrix
    y = y if fused.bias is None else y + fused.bias
    return jnp.split(y, ends[:-1], axis=-1), aux


def _call_kernels(fused: FusedKernels, x: jax.Array) -> Sequence[jax.Array]:
    """Output y of each layer."""
    y = x @ fused.kernel
    y = y if fused.bias is None else y + fused.bias
    return jnp.split(y, list(itertools.accumulate(fused.out_sizes))[:-1], axis=-1)


def _call_shared(
    shared: SharedProjection, x: jax.Array, token_mask: Mask
) -> tuple[Sequence[jax.Array], Aux]:
    """Output y of each layer, and aux with leading axis n."""
    # Without the barrier XLA fuses x W and x P into one matmul and copies W.
    projected = matmul(jax.lax.optimization_barrier(x), shared.down)
    z, aux = _bottleneck(shared, projected, 0, token_mask)
    ys, zs = [], jnp.split(z, len(shared.ups), axis=-1)
    for layer_z, kernel, up, bias in zip(
        zs, shared.kernels, shared.ups, shared.biases, strict=True
    ):
        if up is None:  # [W; U] was joined
            y = pad_columns(jnp.concatenate([x, layer_z], axis=-1)) @ kernel.astype(x.dtype)
        else:
            y = base_plus_low_rank(x, layer_z, kernel, up)
        ys.append(y if bias is None else y + bias)
    return ys, aux


def _bottleneck(
    arrays: FusedLayers | SharedProjection, projected: jax.Array, start: int, token_mask: Mask
) -> tuple[jax.Array, Aux]:
    """Concatenated z of all layers, in the dtype of `projected`, and aux.

    The columns of x P begin at `start` in `projected`.
    """
    f, width, out_sizes = arrays.bottleneck
    columns = range(start, start + len(out_sizes) * width, width)
    z, aux = f.stacked_bottlenecks(arrays.params, projected, columns, token_mask)
    return z.astype(projected.dtype), aux


def matmul(x: jax.Array, matrix: jax.Array) -> jax.Array:
    """x [..., I] @ matrix [I, O], in the dtype of x; split-K if there are few output tiles.

    A GPU computes output tiles in parallel, but sums over I sequentially within each tile. Few
    tiles would leave most SMs idle.
    """
    d_in, d_out = matrix.shape
    splits = _num_splits(math.prod(x.shape[:-1]), d_in, d_out)
    if splits == 1:
        return x @ matrix
    x = x.reshape(*x.shape[:-1], splits, d_in // splits)
    matrix = matrix.reshape(splits, d_in // splits, d_out)
    # fp32, so that the splits' sums are rounded once, as in one product.
    partial_sums = jnp.einsum("...pi,pio->p...o", x, matrix, preferred_element_type=jnp.float32)
    return partial_sums.sum(0).astype(x.dtype)


def _num_splits(rows: int, d_in: int, d_out: int) -> int:
    """Number of K splits of [rows, I] @ [I, O], a power of two that divides I."""
    tiles = math.ceil(rows / TILE) * math.ceil(d_out / TILE)
    splits = 1
    while 2 * splits * tiles <= MIN_TILES and d_in % (2 * splits * MIN_SPLIT_SIZE) == 0:
        splits *= 2
    return splits if d_in >= MIN_SPLIT_INPUTS else 1


def _is_fusable(layer: Layer) -> TypeGuard[Dense]:
    """Whether `fuse_layers` can fuse the layer."""
    if type(layer) is not Dense or layer.adapter is None or layer.dtype is None:
        return False
    method, _ = layer.method_and_params()
    is_sum = method.is_low_rank_sum and not method.down_in_fp32
    return is_sum and len(layer.kernel_matrices().shape) == 2  # quantized kernels have no ndim


def _is_plain(layer: Layer) -> TypeGuard[Dense]:
    """Whether the layer has a single matrix, no adapter and an explicit dtype."""
    if type(layer) is not Dense or layer.adapter is not None or layer.dtype is None:
        return False
    return len(layer.kernel_matrices().shape) == 2  # quantized kernels have no ndim


def _is_quantized(layer: Layer) -> bool:
    return isinstance(layer, Dense) and isinstance(layer.kernel_matrices(), QuantizedKernel)


def _matrices(
    layers: Sequence[Dense],
) -> tuple[list[jax.Array], list[jax.Array], list[jax.Array], list[jax.Array | None]]:
    """W unless it is quantized, P, U and bias of each layer, in the compute dtype."""
    method, _ = layers[0].method_and_params()
    params, dtype = [layer.method_and_params()[1] for layer in layers], layers[0].dtype
    kernels = [layer.kernel_matrices() for layer in layers]
    biases = [None if layer.bias is None else layer.bias.get_value() for layer in layers]
    return (
        [k if isinstance(k, QuantizedKernel) else k.astype(dtype) for k in kernels],
        [method.down(p).astype(dtype) for p in params],
        [method.up(p).astype(dtype) for p in params],
        [None if bias is None else bias.astype(dtype) for bias in biases],
    )


def _bottleneck_spec(
    layers: Sequence[Dense], downs: Sequence[jax.Array]
) -> tuple[BottleneckSpec, Any]:
    """The `BottleneckSpec`, and the parameters of f as in `FusedLayers`."""
    adapters = [layer.method_and_params() for layer in layers]
    # One kernel must fit all layers. After pruning, they may score different numbers of directions.
    implementations = {method.implementation(params) for method, params in adapters}
    f = implementations.pop() if len(implementations) == 1 else adapters[0][0]

    # f does not read leaves whose shapes differ, such as LoRA's B, which is U.
    def stack(*leaves: jax.Array) -> jax.Array | None:
        return jnp.stack(leaves) if len({leaf.shape for leaf in leaves}) == 1 else None

    packed = (f.pack(method.bottleneck_params(params)) for method, params in adapters)
    params = jax.tree.map(stack, *packed)
    out_sizes = tuple(layer.kernel_matrices().shape[1] for layer in layers)
    return BottleneckSpec(f, downs[0].shape[1], out_sizes), params


def _with_copied_kernels(layers: Sequence[Dense]) -> FusedLayers | SharedProjection:
    is_wide = sum(layer.kernel_matrices().shape[1] for layer in layers) > MAX_FUSED_OUTPUTS
    return _shared_projection(layers, join=True) if is_wide else _fused_layers(layers)


def _shared_projection(layers: Sequence[Dense], *, join: bool = False) -> SharedProjection:
    """Concatenate only the P of all layers; with `join`, also W and U of each layer."""
    kernels, downs, ups, biases = _matrices(layers)
    down, spec = pad_columns(jnp.concatenate(downs, axis=1)), _bottleneck_spec(layers, downs)
    if join:
        joined = [pad_columns(jnp.concatenate(pair).T).T for pair in zip(kernels, ups, strict=True)]
        return SharedProjection(*spec, down, [None] * len(ups), joined, biases)
    return SharedProjection(*spec, down, ups, kernels, biases)


def _fused_layers(layers: Sequence[Dense]) -> FusedLayers:
    kernels, downs, ups, biases = _matrices(layers)
    return FusedLayers(
        *_bottleneck_spec(layers, downs),
        input_matrix=pad_columns(jnp.concatenate(kernels + downs, axis=1)),
        output_matrix=jax.scipy.linalg.block_diag(*ups),
        bias=_joined_bias(kernels, biases),
    )


def _fused_kernels(layers: Sequence[Dense]) -> FusedKernels:
    kernels = [layer.kernel_matrices().astype(layer.dtype) for layer in layers]
    biases = [None if layer.bias is None else layer.bias.get_value() for layer in layers]
    return FusedKernels(
        jnp.concatenate(kernels, axis=1),
        _joined_bias(kernels, biases),
        tuple(kernel.shape[1] for kernel in kernels),
    )


def _joined_bias(
    kernels: Sequence[jax.Array], biases: Sequence[jax.Array | None]
) -> jax.Array | None:
    """Biases of all layers [ΣO] in the dtype of their kernels, with zeros for those without one."""
    if all(bias is None for bias in biases):
        return None
    zeros = (jnp.zeros(kernel.shape[1], kernel.dtype) for kernel in kernels)
    pairs = zip(zeros, biases, strict=True)
    return jnp.concatenate([z if bias is None else bias.astype(z.dtype) for z, bias in pairs])
