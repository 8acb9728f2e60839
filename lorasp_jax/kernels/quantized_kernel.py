"""Frozen kernels in 8 or 4 bits, and what they cost: int8 by column, nf4 in blocks of 64 inputs.

Symmetric, scaled by the largest magnitude of what shares a scale. nf4 is the 4-bit NormalFloat of
QLoRA (Dettmers et al., arXiv 2305.14314, appendix E), without its second quantisation of the
scales: 4.5 bits a weight. With m the largest magnitude under a scale, a weight is off by at most
m/255 in int8 and 0.152 m in nf4, half the widest gap of its table. The product under an adapter
widens a kernel where it multiplies by it, again in the backward pass, and keeps the codes alone.
"""

import dataclasses
import functools
import math
from typing import Any, Literal, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

Kind: TypeAlias = Literal["int8", "nf4"]
KINDS: tuple[Kind, ...] = ("int8", "nf4")
NF4_BLOCK = 64
INT8_BOUND = 127.5  # half a step above 127, so that the outermost codes are used like the others
# Quantiles of a normal distribution, 0 among them, scaled to [-1, 1]; arXiv 2305.14314, appendix E.
NF4 = (
    -1.0, -0.6961928009986877, -0.5250730514526367, -0.39491748809814453, -0.28444138169288635,
    -0.18477343022823334, -0.09105003625154495, 0.0, 0.07958029955625534, 0.16093020141124725,
    0.24611230194568634, 0.33791524171829224, 0.44070982933044434, 0.5626170039176941,
    0.7229568362236023, 1.0,
)  # fmt: skip


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class QuantizedKernel:
    """A kernel [..., I, O] in the place of an array: it has a shape and a type, and `astype`.

    A pytree whose arrays keep the leading axes, so scan, vmap and sharding take it as it is.
    """

    codes: jax.Array
    """int8 [..., 1, I, O]; or nf4, uint8 [..., I/64, 32, O]: row i of a block in the low half of a
    byte, row i + 32 in the high half."""
    scale: jax.Array
    """f32 [..., 1 or I/64, 1, O]."""
    d_in: int = dataclasses.field(metadata={"static": True})
    """I; the last block may be longer than what is left of it."""
    dtype: Any = dataclasses.field(metadata={"static": True})
    """The type that it stands for."""
    axes: tuple[int, ...] | None = dataclasses.field(default=None, metadata={"static": True})
    """Where it stands for an einsum's kernel, the sizes of that one's axes: its shape after the
    axes of a stack. The codes stay matrices, and so does what `astype` gives."""
    batch: int = dataclasses.field(default=0, metadata={"static": True})
    """How many of the codes' leading axes are among them."""

    @property
    def shape(self) -> tuple[int, ...]:
        """[..., I, O], or [..., *axes]."""
        leading = self.codes.shape[:-3]
        if self.axes is None:
            return *leading, self.d_in, self.codes.shape[-1]
        return *leading[: len(leading) - self.batch], *self.axes

    @property
    def nbytes(self) -> int:
        """Bytes of codes and scales."""
        return self.codes.nbytes + self.scale.nbytes

    def astype(self, dtype: Any) -> jax.Array:
        """The kernel as an array [..., I, O]."""
        if self.codes.dtype == jnp.int8:
            values = self.codes.astype(jnp.float32)
        else:
            halves = [self.codes & 15, self.codes >> 4]
            values = jnp.array(NF4, jnp.float32)[jnp.concatenate(halves, axis=-2)]
        *leading, blocks, rows, d_out = values.shape
        whole = (values * self.scale).astype(dtype).reshape(*leading, blocks * rows, d_out)
        return whole[..., : self.d_in, :]

    def reshape(self, *shape: Any) -> "QuantizedKernel":
        """With other leading axes; -1 is allowed as in `jnp.reshape`.

        Raises:
          ValueError: another [I, O].
        """
        *leading, d_in, d_out = np.empty(self.shape, np.void).reshape(*shape).shape
        if (d_in, d_out) != self.shape[-2:]:
            raise ValueError(f"a quantised kernel {self.shape} cannot become {shape}.")
        arrays = {n: getattr(self, n) for n in ("codes", "scale")}
        return dataclasses.replace(
            self, **{n: a.reshape(*leading, *a.shape[-3:]) for n, a in arrays.items()}
        )


def quantized(kernel: jax.Array, kind: Kind) -> QuantizedKernel:
    """A kernel [..., I, O] in int8 or nf4, every code the nearest.

    Raises:
      ValueError: an unknown kind, or a kernel with a value that is not finite.
    """
    if kind not in KINDS:
        raise ValueError(f"kernels can be {' or '.join(KINDS)}, got {kind!r}.")
    codes, scale = _codes(kernel, kind)
    if not bool(jnp.isfinite(scale).all()):
        raise ValueError("a kernel with infinite or undefined values cannot be quantised.")
    return QuantizedKernel(codes, scale, kernel.shape[-2], jnp.dtype(kernel.dtype))


@functools.partial(jax.jit, static_argnames="kind")
def _codes(kernel: jax.Array, kind: Kind) -> tuple[jax.Array, jax.Array]:
    """Codes and scales of a `QuantizedKernel`."""
    *leading, d_in, d_out = kernel.shape
    values = kernel.astype(jnp.float32)
    if kind == "nf4":
        blocks = math.ceil(d_in / NF4_BLOCK)
        padding = [(0, 0)] * len(leading) + [(0, blocks * NF4_BLOCK - d_in), (0, 0)]
        values = jnp.pad(values, padding).reshape(*leading, blocks, NF4_BLOCK, d_out)
    else:
        values = values[..., None, :, :]
    largest = jnp.abs(values).max(-2, keepdims=True)
    scale = largest / (1 if kind == "nf4" else INT8_BOUND)
    relative = values / jnp.where(scale > 0, scale, 1)
    return _nf4(relative) if kind == "nf4" else _int8(relative), scale


def _int8(relative: jax.Array) -> jax.Array:
    return jnp.clip(jnp.round(relative), -128, 127).astype(jnp.int8)


def _nf4(relative: jax.Array) -> jax.Array:
    """Codes of values [..., 64, O] in [-1, 1], two to a byte."""
    table = np.array(NF4, np.float32)
    codes = jnp.searchsorted((table[1:] + table[:-1]) / 2, relative).astype(jnp.uint8)
    low, high = jnp.split(codes, 2, axis=-2)
    return low | (high << 4)
