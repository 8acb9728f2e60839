"""Frozen weights quantized to float8, int8 or nf4.

There is no zero point, only a scale: one per matrix in float8, one per column in int8, one per 64
inputs of a column in nf4. float8 is e4m3: 4 bits of exponent, 3 of mantissa. nf4 is the 4-bit
NormalFloat of QLoRA (Dettmers et al., arXiv 2305.14314, appendix E) without double quantization of
the scales, and takes 4.5 bits per weight. Let m be the largest magnitude of the weights that share
a scale. Their error is at most 1/16 of a weight or 2⁻¹⁰ m/448 in float8, m/255 in int8, and 0.152 m
in nf4 (half the widest gap of the table). Adapted layers store only codes and scales, and
dequantize the kernel at each matmul of both passes, unless the device multiplies float8 (see
`lorasp_jax.kernels.frozen_matmul`).
"""

import dataclasses
import functools
import math
from typing import Any, Literal, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

Kind: TypeAlias = Literal["float8", "int8", "nf4"]
KINDS: tuple[Kind, ...] = ("float8", "int8", "nf4")
FLOAT8_BOUND = 448.0
"""Largest finite number of e4m3; the scale is the largest magnitude divided by this."""
NF4_BLOCK = 64
"""Inputs per scale in nf4 (arXiv 2305.14314, section 3)."""
INT8_BOUND = 127.5
"""The scale is the largest magnitude divided by this. Half a step above 127, it gives the outermost
codes a full bin, as in qwix 0.1.8."""
# Quantiles of a normal distribution, including 0, scaled to [-1, 1]; arXiv 2305.14314, appendix E.
NF4 = (
    -1.0, -0.6961928009986877, -0.5250730514526367, -0.39491748809814453, -0.28444138169288635,
    -0.18477343022823334, -0.09105003625154495, 0.0, 0.07958029955625534, 0.16093020141124725,
    0.24611230194568634, 0.33791524171829224, 0.44070982933044434, 0.5626170039176941,
    0.7229568362236023, 1.0,
)  # fmt: skip


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class QuantizedKernel:
    """A quantized kernel [..., I, O] with the `shape`, `dtype` and `astype` of an array.

    A pytree; its arrays keep the kernel's leading axes, so it works with scan, vmap and sharding.
    """

    codes: jax.Array
    """float8 (e4m3fn): [..., 1, O, I], since a product x W in float8 wants I last. int8:
    [..., 1, I, O]. nf4: uint8 [..., I/64, 32, O], with row i of a block in the low four bits and
    row i + 32 in the high four."""
    scale: jax.Array
    """f32 [..., 1 or I/64, 1, O]; float8: [..., 1, 1, 1]."""
    d_in: int = dataclasses.field(metadata={"static": True})
    """I; the last nf4 block is padded unless I is a multiple of 64."""
    dtype: Any = dataclasses.field(metadata={"static": True})
    """Dtype of the original kernel."""
    axes: tuple[int, ...] | None = dataclasses.field(default=None, metadata={"static": True})
    """Shape of the original einsum kernel without stacked axes; None for a matrix. Codes are
    matrices in either case, as is the result of `astype`."""
    batch: int = dataclasses.field(default=0, metadata={"static": True})
    """Number of batch axes of the einsum; in the codes, they follow the stacked axes."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the original kernel: [..., I, O], or [..., *axes]."""
        leading = self.codes.shape[:-3]
        if self.axes is None:
            return *leading, self.d_in, self.codes.shape[-2 if self.kind == "float8" else -1]
        return *leading[: len(leading) - self.batch], *self.axes

    @property
    def kind(self) -> Kind:
        """How the kernel is quantized."""
        kinds: dict[str, Kind] = {"float8_e4m3fn": "float8", "int8": "int8", "uint8": "nf4"}
        return kinds[self.codes.dtype.name]

    @property
    def nbytes(self) -> int:
        """Size of codes and scales in bytes."""
        return self.codes.nbytes + self.scale.nbytes

    def astype(self, dtype: Any) -> jax.Array:
        """Dequantize to an array [..., I, O]."""
        if self.kind == "float8":
            return (self.codes.astype(jnp.float32) * self.scale).astype(dtype).squeeze(-3).mT
        if self.kind == "nf4":
            halves = [self.codes & 15, self.codes >> 4]
            values = jnp.array(NF4, jnp.float32)[jnp.concatenate(halves, axis=-2)]
        else:
            values = self.codes.astype(jnp.float32)
        *leading, blocks, rows, d_out = values.shape
        kernel = (values * self.scale).astype(dtype).reshape(*leading, blocks * rows, d_out)
        return kernel[..., : self.d_in, :]

    def reshape(self, *shape: Any) -> "QuantizedKernel":
        """Reshape the axes before [I, O]; -1 is inferred, as in `jnp.reshape`."""
        leading = np.empty(self.shape, np.void).reshape(*shape).shape[:-2]
        arrays = {n: getattr(self, n) for n in ("codes", "scale")}
        return dataclasses.replace(
            self, **{n: a.reshape(*leading, *a.shape[-3:]) for n, a in arrays.items()}
        )


def quantize_kernel(kernel: jax.Array, kind: Kind) -> QuantizedKernel:
    """Quantize a kernel [..., I, O], rounding to the nearest code.

    Raises:
        ValueError: non-finite values, which go unnoticed while JAX traces.
    """
    codes, scale = _codes(kernel, kind)
    if not isinstance(scale, jax.core.Tracer) and not bool(jnp.isfinite(scale).all()):
        raise ValueError("the kernel has NaN or infinite values")
    return QuantizedKernel(codes, scale, kernel.shape[-2], jnp.dtype(kernel.dtype))


@functools.partial(jax.jit, static_argnames="kind")
def _codes(kernel: jax.Array, kind: Kind) -> tuple[jax.Array, jax.Array]:
    """Compute the codes and scales of a `QuantizedKernel`.

    One layer of a stack after another: fp32 copies of all of them would not fit in small GPUs.
    """
    if kernel.ndim > 2:
        return jax.lax.map(functools.partial(_codes, kind=kind), kernel)
    d_in, d_out = kernel.shape
    values = (kernel.mT if kind == "float8" else kernel).astype(jnp.float32)
    if kind == "nf4":
        blocks = math.ceil(d_in / NF4_BLOCK)
        padded = jnp.pad(values, [(0, blocks * NF4_BLOCK - d_in), (0, 0)])
        values = padded.reshape(blocks, NF4_BLOCK, d_out)
    else:
        values = values[None]
    largest = jnp.abs(values).max((-2, -1) if kind == "float8" else -2, keepdims=True)
    scale = largest / {"float8": FLOAT8_BOUND, "int8": INT8_BOUND, "nf4": 1}[kind]
    encode = {"float8": _float8, "int8": _int8, "nf4": _nf4}[kind]
    return encode(values / jnp.where(scale > 0, scale, 1)), scale


def _float8(relative: jax.Array) -> jax.Array:
    return relative.astype(jnp.float8_e4m3fn)


def _int8(relative: jax.Array) -> jax.Array:
    return jnp.clip(jnp.round(relative), -128, 127).astype(jnp.int8)


def _nf4(relative: jax.Array) -> jax.Array:
    """Encode values [..., 64, O] in [-1, 1], two codes per byte."""
    table = np.array(NF4, np.float32)
    codes = jnp.searchsorted((table[1:] + table[:-1]) / 2, relative).astype(jnp.uint8)
    low, high = jnp.split(codes, 2, axis=-2)
    return low | (high << 4)
