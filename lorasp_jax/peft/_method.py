"""What an adapter method is.

A method is a frozen dataclass that is its own configuration. It holds no arrays: `init` makes its
parameters, a pytree, and the other methods are pure functions of them. It knows no framework; the
shells for NNX and Linen are in `lorasp_jax.dense`.
"""

import contextlib
import dataclasses
import difflib
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, Protocol, TypeAlias

import jax
import jax.numpy as jnp
import optax

from lorasp_jax.kernels.low_rank_matmul import LowRankLayer, low_rank_matmul, one_by_one
from lorasp_jax.peft import _fields
from lorasp_jax.peft._aux import Aux

Params: TypeAlias = Any


class Shaped(Protocol):
    """What a jax.ShapeDtypeStruct has, whose own types JAX leaves open."""

    shape: Any
    dtype: Any


Kernel: TypeAlias = jax.Array | Shaped

LARGEST_SIZE = 2**20
"""Of a rank, a width and the like: what is larger is a mistake, and would ask for all memory."""
LARGEST_ALPHA = 1e30
"""Of α and 1/α: α/R is then neither infinite nor zero in fp32."""


class Method:
    """Base of all methods. An additive one writes `init_params`, `down`, `between` and `up`:

        delta = z U    with z, aux = between(params, x P)

    x is [...tokens, I], a kernel [I, O]; the result has the type of x. Parameters are fp32.
    """

    def __new__(cls, *values: Any, **fields: Any) -> "Method":
        """Raises a ValueError for a field that there is not, before Python's own TypeError."""
        check_names(cls, values, fields)
        return super().__new__(cls)

    def __post_init__(self) -> None:
        """Raises a ValueError for a field of another type, or a number that no method can use."""
        for field in dataclasses.fields(self):  # pyright: ignore[reportArgumentType]
            value = getattr(self, field.name)
            if type(value) is int and value > LARGEST_SIZE:
                raise ValueError(f"{field.name} must be at most {LARGEST_SIZE}, got {value}.")
        _fields.check_fields(self)
        alpha = getattr(self, "alpha", None)
        if alpha is not None and not 1 / LARGEST_ALPHA <= abs(alpha) <= LARGEST_ALPHA:
            raise ValueError(f"alpha must not be 0 nor beyond {LARGEST_ALPHA:g}, got {alpha}.")
        if not 0 <= (rate := drop_rate(self)) < 1:
            raise ValueError(f"dropout must be at least 0 and less than 1, got {rate}.")

    trains_base: ClassVar[bool] = False
    """True if the base weights themselves are what trains."""
    additive: ClassVar[bool] = True
    """True if the adapted map is x @ kernel + delta."""

    @property
    def splits_kernel(self) -> bool:
        """True if `init` takes a part of the kernel, which then lacks it, into the parameters."""
        return False

    @property
    def reads_in_fp32(self) -> bool:
        """True if x P must not be rounded to the type of x."""
        return False

    @property
    def gains_together(self) -> bool:
        """True if `between_all` costs less than `between` of each layer."""
        return False

    @property
    def name(self) -> str:
        """As `create` takes it."""
        return name_of(type(self))

    @property
    def needs_statistics(self) -> bool:
        """True if `init` asks for the statistics of the layer's inputs."""
        return False

    @property
    def as_saved(self) -> "Method":
        """The method as it is saved with its parameters, under which they can be loaded."""
        return self

    def init(
        self, key: jax.Array, kernel: Kernel, *, statistics: Any = None
    ) -> tuple[Params, Kernel]:
        """Fresh parameters for one kernel, under which the adapted map still equals x @ kernel.

        Args:
          key: typed random key.
          kernel: [I, O], or its ShapeDtypeStruct: only shape is read here.
          statistics: activations' statistics, for initialisations that look at data.

        Returns:
          The parameters, and the kernel as it came (initialisations that split it return the rest).

        Raises:
          ValueError: the kernel is not a matrix, or the key is none.
        """
        del statistics
        check_matrix(kernel)
        return self.init_params(_fields.key(key), *kernel.shape), kernel

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """Fresh parameters for a kernel [d_in, d_out], a pure function of key and shape."""
        raise NotImplementedError

    def down(self, params: Params) -> jax.Array:
        """P [I, Q], the matrix that reads x."""
        raise NotImplementedError

    def between(
        self, params: Params, rows: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """What happens between the two matrices, row by row.

        Args:
          params: from `init`.
          rows: x P, [...tokens, Q] in the type of x, or in fp32 where `reads_in_fp32`.
          token_mask: as for `delta`.

        Returns:
          z [...tokens, R], to be multiplied by U, and aux without its token_mask.
        """
        raise NotImplementedError

    def for_rows(self, params: Params) -> Params:
        """What `between` takes in place of `params`, for many calls: work on these done once."""
        return params

    def between_all(
        self, params: Params, read: jax.Array, columns: range, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """`between` of n layers whose rows lie side by side.

        Args:
          params: of `for_rows`, [n, ...].
          read: [...tokens, C], which holds the rows.
          columns: the first column of each layer's Q.
          token_mask: as for `delta`.

        Returns:
          z of all layers side by side [...tokens, n R], and aux [n, ...] without its token_mask.
        """
        tokens, (n, width) = read.shape[:-1], (len(columns), columns.step)
        rows = read[..., columns.start : columns.stop].reshape(*tokens, n, width)

        def one(params: Params, rows: jax.Array) -> tuple[jax.Array, Aux]:
            return self.between(params, rows, token_mask)

        z, aux = jax.vmap(one, in_axes=(0, -2), out_axes=(-2, 0))(params, rows)
        return z.reshape(*tokens, -1), aux

    def up(self, params: Params) -> jax.Array:
        """U [R, O], the matrix that writes y."""
        raise NotImplementedError

    def delta(
        self, params: Params, x: jax.Array, *, token_mask: jax.Array | None = None
    ) -> tuple[jax.Array, Aux]:
        """What the adapter adds to x @ kernel, [...tokens, O].

        Args:
          params: from `init`.
          x: [...tokens, I].
          token_mask: bool [...tokens]; False (padding) stays out of losses and statistics.

        Raises:
          ValueError: the method is not additive, x or the mask is no such array, or the parameters
            are another method's.
        """
        _fields.tokens(x, token_mask)
        if not self.additive:
            raise ValueError(f"{type(self).__name__} is not additive and has no delta; use apply.")
        z, aux = self.read(params, x, token_mask)
        up = self.up(params).astype(x.dtype)
        self._check_params(params, (x.shape[-1], up.shape[-1]))
        return z @ up, dataclasses.replace(aux, token_mask=token_mask)

    def read(
        self, params: Params, x: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """z [...tokens, R] in the type of x and aux, from x itself."""
        down = self.down(params).astype(x.dtype)
        rows = jnp.matmul(x, down, preferred_element_type=self._rows_dtype(x))
        z, aux = self.between(params, rows, token_mask)
        return z.astype(x.dtype), aux

    def apply(
        self,
        params: Params,
        x: jax.Array,
        kernel: jax.Array,
        *,
        token_mask: jax.Array | None = None,
    ) -> tuple[jax.Array, Aux]:
        """The adapted linear map without its bias, [...tokens, O]: x @ kernel + delta, fused.

        No gradient reaches `kernel`; arguments as for `delta`.

        Raises:
          ValueError: x, the mask or the kernel is no such array, or the parameters are another's.
        """
        _fields.tokens(x, token_mask)
        layers = [(self, params, kernel)]
        with _checked(layers, x):
            return _apply_fused(layers, x, token_mask)[0]

    def apply_dropped(
        self,
        params: Params,
        x: jax.Array,
        kernel: jax.Array,
        key: jax.Array,
        *,
        token_mask: jax.Array | None = None,
    ) -> tuple[jax.Array, Aux]:
        """`apply` in training, where the adapter reads `dropped` x and the kernel all of x.

        A method that is not additive also rescales what the kernel makes of the dropped x, and
        leaves the rest of x W as it is (Hugging Face PEFT's DoRA).

        Args:
          params: from `init`.
          x: [...tokens, I].
          kernel: [I, O]; no gradient reaches it.
          key: typed random key.
          token_mask: as for `delta`.
        """
        seen = dropped(x, drop_rate(self), key)
        kernel = jax.lax.stop_gradient(kernel.astype(x.dtype))
        if self.additive:
            delta, aux = self.delta(params, seen, token_mask=token_mask)
            return x @ kernel + delta, aux
        y, aux = self.apply(params, seen, kernel, token_mask=token_mask)
        return (x - seen) @ kernel + y, aux

    def _rows_dtype(self, x: jax.Array) -> Any:
        return jnp.float32 if self.reads_in_fp32 else x.dtype

    def _check_params(self, params: Params, shape: tuple[int, ...]) -> None:
        if type(self).init_params is not Method.init_params:
            _fields.check_params(self, params, shape)

    def penalty(self, params: Params) -> dict[str, jax.Array]:
        """Losses on the parameters alone, by name."""
        del params
        return {}

    def transform(
        self, optimizer: optax.GradientTransformation, total_steps: int
    ) -> optax.GradientTransformation:
        """The optimizer with what the method does after each of its `total_steps` steps."""
        del total_steps
        return optimizer

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """The kernel [I, O] with the adapter folded in, in the kernel's type.

        Raises:
          ValueError: the delta depends on the input.
        """
        raise NotImplementedError


def apply_together(
    layers: Sequence[tuple[Method, Params, jax.Array]],
    x: jax.Array,
    *,
    token_mask: jax.Array | None = None,
) -> list[tuple[jax.Array, Aux]]:
    """`apply` of several layers (method, params, kernel) to one input, which is read once.

    Once for all layers whose methods leave `apply` as it is and agree in `reads_in_fp32`; no
    gradient reaches their kernels.
    """
    groups: dict[bool, list[int]] = {}
    found: dict[int, tuple[jax.Array, Aux]] = {}
    with _checked(layers, x):
        for i, (method, params, kernel) in enumerate(layers):
            if type(method).apply is Method.apply:
                groups.setdefault(method.reads_in_fp32, []).append(i)
            else:
                found[i] = method.apply(params, x, kernel, token_mask=token_mask)
        for members in groups.values():
            fused = _apply_fused([layers[i] for i in members], x, token_mask)
            found |= zip(members, fused, strict=True)
    return [found[i] for i in range(len(layers))]


@contextlib.contextmanager
def _checked(layers: Sequence[tuple[Method, Params, jax.Array]], x: jax.Array) -> Iterator[None]:
    """Says what of the layers does not fit: at once, or in place of an error that it led to."""
    try:
        for method, params, kernel in layers:
            method._check_params(params, kernel.shape)
        yield
    except (TypeError, LookupError, AttributeError, ValueError):
        for _, _, kernel in layers:
            check_matrix(kernel)
            width, shape = x.shape[-1], kernel.shape
            if width != shape[0]:
                raise ValueError(f"input of width {width} meets a kernel {list(shape)}.") from None
        raise


def _apply_fused(
    layers: Sequence[tuple[Method, Params, jax.Array]], x: jax.Array, token_mask: jax.Array | None
) -> list[tuple[jax.Array, Aux]]:
    rows_dtype = layers[0][0]._rows_dtype(x)
    arrays = [
        LowRankLayer(params, kernel, method.down(params), method.up(params))
        for method, params, kernel in layers
    ]
    between = _Between(tuple(method for method, _, _ in layers))
    found: Any = low_rank_matmul(between, rows_dtype, arrays, x, token_mask)
    return [(y, dataclasses.replace(aux, token_mask=token_mask)) for y, aux in found]


@dataclasses.dataclass(frozen=True)
class _Between:
    """`between` of all layers, in one call where they have one method that gains by it."""

    methods: tuple[Method, ...]

    def __call__(
        self,
        params: Sequence[Params],
        read: jax.Array,
        widths: Sequence[int],
        token_mask: jax.Array | None,
    ) -> list[tuple[jax.Array, Aux]]:
        """z and aux of each; arguments as for `low_rank_matmul.InnerFunction`."""
        first, n = self.methods[0], len(self.methods)
        if n == 1 or not first.gains_together or any(method != first for method in self.methods):
            each = one_by_one([method.between for method in self.methods])
            return each(params, read, widths, token_mask)
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(first.for_rows, params))
        columns = range(0, sum(widths), widths[0])
        z, aux = first.between_all(stacked, read, columns, token_mask)
        of_each = [jax.tree.map(lambda a, i=i: a[i], aux) for i in range(n)]
        return list(zip(jnp.split(z, n, axis=-1), of_each, strict=True))


def name_of(cls: type[Method]) -> str:
    """The name of the file that defines a method, or of the folder around its `method.py`."""
    folder, _, file = cls.__module__.rpartition(".")
    return folder.rpartition(".")[2] if file == "method" else file


def check_names(cls: type[Method], values: Sequence[Any], fields: Sequence[str] | dict) -> None:
    """Raises a ValueError unless these are values and names for a method's fields."""
    valid = [field.name for field in dataclasses.fields(cls)]  # pyright: ignore[reportArgumentType]
    name = name_of(cls)
    if len(values) > len(valid):
        raise ValueError(f"{name} has {len(valid)} fields, not {len(values)}: {', '.join(valid)}.")
    for field in fields:
        if field not in valid:
            close = difflib.get_close_matches(field, valid, n=1, cutoff=0.4)
            hint = f" (did you mean {close[0]!r}?)" if close else ""
            raise ValueError(
                f"{name} has no field {_fields.short(field)}{hint}; valid are {', '.join(valid)}."
            )


def check_matrix(kernel: Kernel) -> None:
    """Raises a ValueError unless it is one of real numbers, or such a shape."""
    shape, dtype = getattr(kernel, "shape", ()), getattr(kernel, "dtype", int)
    if len(shape) != 2 or 0 in shape or not jnp.issubdtype(dtype, jnp.floating):
        found = f"{dtype} {list(shape)}" if hasattr(kernel, "dtype") else type(kernel).__name__
        raise ValueError(f"an adapter needs a kernel [I, O] of real numbers, got {found}.")


def drop_rate(method: Any) -> float:
    """`dropout` of a method that has such a field, 0 of others."""
    return getattr(method, "dropout", 0.0)


def dropped(x: jax.Array, rate: float, key: jax.Array) -> jax.Array:
    """x with each number at 0 with probability `rate`, and divided by 1 - rate otherwise."""
    kept = jax.random.bernoulli(key, 1 - rate, x.shape)
    return jnp.where(kept, x / (1 - rate), 0).astype(x.dtype)


def kaiming_uniform(key: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """U(±1/√I) for an [I, R] matrix: Kaiming-uniform with a = √5, as in torch and PEFT."""
    bound = shape[0] ** -0.5
    return jax.random.uniform(key, shape, jnp.float32, -bound, bound)
