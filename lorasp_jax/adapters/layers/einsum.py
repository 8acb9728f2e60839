"""Adapted einsums: kernels with any number of input, output and batch axes.

In an equation "x,kernel->y", x and y contain one "..." each, or none. Each kernel axis is one of
these:

    batch    in x, kernel and y; each index has its own linear map, as in a mixture of experts
    input    in x and kernel; summed over
    output   in kernel and y

An adapter treats the kernel as a stack of matrices [*batch, I, O]: input and output axes are
flattened to I and O, in the kernel's order. Its parameters have the batch axes as leading axes. For
example, "BTD,NDH->BTNH" has one adapter with D inputs and N·H outputs. A quantized kernel is stored
as such a stack, along with the sizes of its original axes.
"""

import dataclasses
import math
import re
import string
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from lorasp_jax.dense import DenseLayer, apply_layer
from lorasp_jax.kernels.quantized_weights import QuantizedKernel
from lorasp_jax.peft import Aux, Method
from lorasp_jax.peft.fields import short
from lorasp_jax.peft.method import Params

LINEAR = "...i,io->...o"
_EQUATION = re.compile(r"{0},([a-zA-Z]+)->{0}".format(r"([a-zA-Z]*(?:\.\.\.)?[a-zA-Z]*)"))


class Axes(NamedTuple):
    """Axis letters of x, kernel and y in an equation; those of x and y may contain "..."."""

    x: str
    kernel: str
    y: str

    @property
    def batch(self) -> str:
        """Kernel axes that are also in x and y, in the kernel's order."""
        return "".join(c for c in self.kernel if c in self.x and c in self.y)

    @property
    def inputs(self) -> str:
        """Kernel axes that are summed over, in the kernel's order."""
        return "".join(c for c in self.kernel if c not in self.y)

    @property
    def outputs(self) -> str:
        """Kernel axes that are not in x, in the kernel's order."""
        return "".join(c for c in self.kernel if c not in self.x)

    def expanded(self, ndim: int) -> "Axes":
        """Replace "..." by letters, for an x with `ndim` axes.

        Raises:
            ValueError: the equation does not allow `ndim` axes.
        """
        letters = (c for c in string.ascii_letters if c not in self.x + self.kernel + self.y)
        count = ndim - len(self.x.replace("...", ""))
        if count < 0 or (count and "..." not in self.x):
            raise ValueError(
                f"input with {ndim} axes does not match the equation "
                f"{self.x},{self.kernel}->{self.y}"
            )
        dots = "".join(next(letters) for _ in range(count))
        return Axes(self.x.replace("...", dots), self.kernel, self.y.replace("...", dots))


def parse(equation: str) -> Axes:
    """Parse an equation.

    Raises:
        ValueError: the equation is not a linear map from x to y for each index of the batch axes.
    """
    match = _EQUATION.fullmatch(equation.replace(" ", ""))
    axes = Axes(*match.groups()) if match else Axes("", "", "")
    letters = [part.replace("...", "") for part in axes]
    x, kernel, y = map(set, letters)
    unique = all(len(set(part)) == len(part) for part in letters)
    same_dots = ("..." in axes.x) == ("..." in axes.y)
    if not (unique and same_dots and kernel and x ^ y <= kernel <= x | y):
        raise ValueError(
            f"the einsum {short(equation)} cannot be adapted: it must be explicit, 'x,kernel->y', "
            "with each axis in at least two of the three"
        )
    return axes


def general_equation(axis: Sequence[int], batch: Sequence[int], outputs: int) -> str:
    """Equation of a general dense layer with a kernel [*batch, *inputs, *outputs].

    Args:
        axis: axes of x to sum over; negative ones count from the end.
        batch: leading axes 0, 1, ... of x that the kernel also has.
        outputs: number of output axes.
    """
    letters = iter(string.ascii_letters)
    from_start, from_end = sorted(a for a in axis if a >= 0), sorted(a for a in axis if a < 0)
    head = [next(letters) for _ in range(max([-1, *from_start, *batch]) + 1)]
    tail = [next(letters) for _ in range(-min([0, *from_end]))]
    shared = "".join(head[b] for b in sorted(batch))
    summed = "".join([head[a] for a in from_start] + [tail[a] for a in from_end])
    free = ["".join(c for c in part if c not in shared + summed) for part in (head, tail)]
    new = "".join(next(letters) for _ in range(outputs))
    x = f"{''.join(head)}...{''.join(tail)}"
    return f"{x},{shared}{summed}{new}->{shared}{free[0]}...{free[1]}{new}"


def to_matrices(equation: str, kernel: Any) -> Any:
    """Rearrange a kernel, or a stack of kernels, to [..., *batch, I, O]."""
    if isinstance(kernel, QuantizedKernel):
        return dataclasses.replace(kernel, axes=None, batch=0)
    axes, order = _order(equation, kernel.ndim)
    kernel = kernel.transpose(order)
    outer = kernel.ndim - len(axes.inputs + axes.outputs)
    outputs = kernel.shape[outer + len(axes.inputs) :]
    return kernel.reshape(*kernel.shape[:outer], -1, math.prod(outputs))


def from_matrices(equation: str, matrices: Any, shape: Sequence[int]) -> Any:
    """Inverse of `to_matrices`, for a kernel of this shape."""
    axes, order = _order(equation, len(shape))
    if isinstance(matrices, QuantizedKernel):
        sizes = tuple(shape[len(shape) - len(axes.kernel) :])
        return dataclasses.replace(matrices, axes=sizes, batch=len(axes.batch))
    inverse = [order.index(i) for i in range(len(shape))]
    return matrices.reshape([shape[i] for i in order]).transpose(inverse)


def einsum(
    equation: str,
    x: jax.Array,
    kernel: jax.Array | QuantizedKernel,
    bias: jax.Array | None = None,
    params: Params | None = None,
    method: Method | None = None,
    dropout_key: jax.Array | None = None,
) -> tuple[jax.Array, Aux]:
    """Einsum of x and kernel, plus bias; with an adapter if `method` and `params` are given.

    Args:
        equation: "x,kernel->y"; see the module docstring.
        x, kernel: arrays with the axes in the equation.
        bias: has the kernel axes that are also in y, in y's order; or None.
        params: the adapter's parameters for `to_matrices(equation, kernel)`, or None.
        method: the adapter's method; required with `params`.
        dropout_key: as for `dense`.

    Returns:
        y in the dtype of x, and the adapter's aux. Losses are averaged over the batch axes; the
        other arrays in aux have these as leading axes.

    Raises:
        ValueError: the equation cannot be adapted, or the shapes do not match it.
    """
    axes, sizes = _sizes(equation, x, kernel)
    tokens = "".join(c for c in axes.x if c not in axes.kernel)
    order = [axes.x.index(c) for c in axes.batch + tokens + axes.inputs]
    width = math.prod(sizes[c] for c in axes.inputs)  # -1 is ambiguous with zero rows
    rows = x.transpose(order).reshape(*(sizes[c] for c in axes.batch + tokens), width)

    def apply_dense(
        x: jax.Array, matrix: jax.Array, params: Any, key: Any
    ) -> tuple[jax.Array, Aux]:
        return apply_layer(DenseLayer(matrix, None, params, method, key), x, None)

    for _ in axes.batch:
        apply_dense = jax.vmap(apply_dense)
    if dropout_key is not None:
        dropout_key = jax.random.split(dropout_key, tuple(sizes[c] for c in axes.batch))
    y, aux = apply_dense(rows, to_matrices(equation, kernel), params, dropout_key)
    layout = axes.batch + tokens + axes.outputs
    y = y.reshape([sizes[c] for c in layout]).transpose([layout.index(c) for c in axes.y])
    if bias is not None:
        shape = [sizes[c] if c in axes.kernel else 1 for c in axes.y]
        y = y + bias.reshape(shape).astype(y.dtype)
    losses = {name: jnp.mean(values) for name, values in aux.losses.items()}
    return y, dataclasses.replace(aux, losses=losses)


def _sizes(equation: str, x: jax.Array, kernel: Any) -> tuple[Axes, dict[str, int]]:
    """Axes with "..." expanded for x, and their sizes."""
    axes, shape = parse(equation).expanded(x.ndim), kernel.shape
    if len(shape) == len(axes.kernel):
        sizes = dict(zip(axes.kernel + axes.x, shape + x.shape, strict=True))
        if shape == tuple(sizes[c] for c in axes.kernel):
            return axes, sizes
    raise ValueError(f"shapes {x.shape} and {shape} do not match the equation {equation!r}")


def _order(equation: str, ndim: int) -> tuple[Axes, list[int]]:
    """Axes, and the axis order that transposes a kernel to [..., *batch, *inputs, *outputs]."""
    axes = parse(equation)
    outer = ndim - len(axes.kernel)
    layout = axes.batch + axes.inputs + axes.outputs
    return axes, [*range(outer), *(outer + axes.kernel.index(c) for c in layout)]
