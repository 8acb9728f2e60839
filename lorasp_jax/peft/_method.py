"""What an adapter method is.

A method is a frozen dataclass that is its own configuration. It holds no arrays: `init` makes its
parameters, a pytree, and the other methods are pure functions of them. It knows no framework; the
shells for NNX and Linen are in `lorasp_jax.dense`.
"""

import dataclasses
from typing import Any, ClassVar, Protocol, TypeAlias

import jax
import jax.numpy as jnp
import optax

from lorasp_jax.kernels.low_rank_matmul import LowRankLayer, low_rank_matmul
from lorasp_jax.peft import _arguments, _fields
from lorasp_jax.peft._aux import Aux
from lorasp_jax.peft._batched_bottleneck import BatchedBottleneck

Params: TypeAlias = Any


class ShapeLike(Protocol):
    """What a jax.ShapeDtypeStruct has, whose own types JAX leaves open."""

    shape: Any
    dtype: Any


Kernel: TypeAlias = jax.Array | ShapeLike

MAX_SIZE = 2**20
"""Of a rank, a width and the like: what is larger is a mistake, and would ask for all memory."""
MAX_ALPHA = 1e30
"""Of α and 1/α: α/R is then neither infinite nor zero in fp32."""


class Method:
    """Base of all methods. An additive one writes `init_params` and four parts of its update:

        delta = z U,    z, aux = between(middle(params), x P),    P = down(params), U = up(params)

    x is [...tokens, I], a kernel [I, O]; the result has the type of x. Parameters are fp32.
    """

    def __new__(cls, *values: Any, **fields: Any) -> "Method":
        """Raises a ValueError for a field that there is not, before Python's own TypeError."""
        _fields.check_names(cls, name_of(cls), values, fields)
        return super().__new__(cls)

    def __post_init__(self) -> None:
        """Raises a ValueError for a field of another type, or a number that no method can use."""
        for field in dataclasses.fields(self):  # pyright: ignore[reportArgumentType]
            value = getattr(self, field.name)
            if type(value) is int and value > MAX_SIZE:
                raise ValueError(f"{field.name} must be at most {MAX_SIZE}, got {value}.")
        _fields.check_fields(self)
        alpha = getattr(self, "alpha", None)
        if alpha is not None and not 1 / MAX_ALPHA <= abs(alpha) <= MAX_ALPHA:
            raise ValueError(f"alpha must not be 0 nor beyond {MAX_ALPHA:g}, got {alpha}.")
        if not 0 <= (rate := dropout_rate(self)) < 1:
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
    def down_in_fp32(self) -> bool:
        """True if x P must not be rounded to the type of x."""
        return False

    @property
    def is_low_rank_sum(self) -> bool:
        """True if `apply` is x W + z U and nothing else."""
        return type(self).apply is Method.apply

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
        _arguments.matrix(kernel)
        return self.init_params(_arguments.key(key), *kernel.shape), kernel

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """Fresh parameters for a kernel [d_in, d_out], a pure function of key and shape."""
        raise NotImplementedError

    def down(self, params: Params) -> jax.Array:
        """P [I, Q], the matrix that reads x."""
        raise NotImplementedError

    def bottleneck_params(self, params: Params) -> Params:
        """What `bottleneck` reads of the parameters; all, unless a method says less."""
        return params

    def bottleneck(
        self, params: Params, rows: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """What happens between the two matrices, row by row.

        Args:
          params: from `bottleneck_params`.
          rows: x P, [...tokens, Q] in the type of x, or in fp32 where `down_in_fp32`.
          token_mask: as for `delta`.

        Returns:
          z [...tokens, R], to be multiplied by U, and aux without its token_mask.
        """
        raise NotImplementedError

    def fused_kernel(self, params: Params) -> BatchedBottleneck | None:
        """A fused GPU kernel for `bottleneck` at these shapes, or None."""
        del params

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
        _arguments.tokens(x, token_mask)
        if not self.additive:
            raise ValueError(f"{type(self).__name__} is not additive and has no delta; use apply.")
        z, aux = self.bottleneck_from_input(params, x, token_mask)
        up = self.up(params).astype(x.dtype)
        self._check_params(params, (x.shape[-1], up.shape[-1]))
        return z @ up, dataclasses.replace(aux, token_mask=token_mask)

    def bottleneck_from_input(
        self, params: Params, x: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """z [...tokens, R] in the type of x and aux, from x itself."""
        down = self.down(params).astype(x.dtype)
        rows = jnp.matmul(x, down, preferred_element_type=self.rows_dtype(x))
        run = self.fused_kernel(params) or self
        z, aux = run.bottleneck(self.bottleneck_params(params), rows, token_mask)
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
        _arguments.tokens(x, token_mask)
        self.check(params, x, kernel)
        run, layer = self.fused_kernel(params) or self, self.low_rank_layer(params, kernel)
        ((y, aux),) = low_rank_matmul((run,), self.rows_dtype(x), [layer], x, token_mask)
        return y, dataclasses.replace(aux, token_mask=token_mask)

    def apply_with_dropout(
        self,
        params: Params,
        x: jax.Array,
        kernel: jax.Array,
        key: jax.Array,
        *,
        token_mask: jax.Array | None = None,
    ) -> tuple[jax.Array, Aux]:
        """`apply` in training, where the adapter reads x after `dropout` and the kernel all of x.

        A method that is not additive also rescales what the kernel makes of the dropped x, and
        leaves the rest of x W as it is (Hugging Face PEFT's DoRA).

        Args:
          params: from `init`.
          x: [...tokens, I].
          kernel: [I, O]; no gradient reaches it.
          key: typed random key.
          token_mask: as for `delta`.
        """
        seen = dropout(x, dropout_rate(self), key)
        kernel = jax.lax.stop_gradient(kernel.astype(x.dtype))
        if self.additive:
            delta, aux = self.delta(params, seen, token_mask=token_mask)
            return x @ kernel + delta, aux
        y, aux = self.apply(params, seen, kernel, token_mask=token_mask)
        return (x - seen) @ kernel + y, aux

    def low_rank_layer(self, params: Params, kernel: jax.Array) -> LowRankLayer:
        """The arrays of one layer for `low_rank_matmul`."""
        return LowRankLayer(
            self.bottleneck_params(params), kernel, self.down(params), self.up(params)
        )

    def rows_dtype(self, x: jax.Array) -> Any:
        """The type of x P."""
        return jnp.float32 if self.down_in_fp32 else x.dtype

    def check(self, params: Params, x: jax.Array, kernel: jax.Array) -> None:
        """Raises a ValueError unless x, kernel and parameters fit each other."""
        _arguments.matrix(kernel)
        if x.shape[-1] != kernel.shape[0]:
            raise ValueError(f"input of width {x.shape[-1]} meets a kernel {list(kernel.shape)}.")
        self._check_params(params, kernel.shape)

    def _check_params(self, params: Params, shape: tuple[int, ...]) -> None:
        if type(self).init_params is not Method.init_params:
            _arguments.check_params(self, params, shape)

    def shapes(self, made: _arguments.Shapes, found: _arguments.Shapes) -> _arguments.Shapes:
        """The shapes that parameters must have.

        Args:
          made: those that `init_params` makes, by path.
          found: those of the parameters, which may have been pruned.
        """
        del found
        return made

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


def name_of(cls: type[Method]) -> str:
    """The name of the file that defines a method, or of the folder around its `method.py`."""
    folder, _, file = cls.__module__.rpartition(".")
    return folder.rpartition(".")[2] if file == "method" else file


def dropout_rate(method: Any) -> float:
    """`dropout` of a method that has such a field, 0 of others."""
    return getattr(method, "dropout", 0.0)


def dropout(x: jax.Array, rate: float, key: jax.Array) -> jax.Array:
    """x with each number at 0 with probability `rate`, and divided by 1 - rate otherwise."""
    kept = jax.random.bernoulli(key, 1 - rate, x.shape)
    return jnp.where(kept, x / (1 - rate), 0).astype(x.dtype)


def kaiming_uniform(key: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """U(±1/√I) for an [I, R] matrix: Kaiming-uniform with a = √5, as in torch and PEFT."""
    bound = shape[0] ** -0.5
    return jax.random.uniform(key, shape, jnp.float32, -bound, bound)
