"""Base class for adapter methods.

A method is a frozen dataclass of hyperparameters and holds no arrays. `init` creates the parameter
pytree; everything else is a pure function of it. The NNX and Linen wrappers are in
`lorasp_jax.dense`.
"""

import dataclasses
import functools
from typing import Any, ClassVar, Protocol, TypeAlias

import jax
import jax.numpy as jnp
import optax

from lorasp_jax.kernels.frozen_matmul import frozen_matmul
from lorasp_jax.kernels.low_rank_matmul import Bottleneck, LowRankLayer, Mask, low_rank_matmul
from lorasp_jax.peft import fields
from lorasp_jax.peft.auxiliary import Aux

Params: TypeAlias = Any


class ShapeLike(Protocol):
    """Typed view of jax.ShapeDtypeStruct, whose attributes JAX leaves untyped."""

    shape: Any
    dtype: Any


Kernel: TypeAlias = jax.Array | ShapeLike

Shapes: TypeAlias = dict[str, tuple[int, ...]]
"""Shapes of parameters by path, such as "router/w2"."""

MAX_SIZE = 2**20
"""Upper bound for ranks and widths. Larger values are likely mistakes."""
MAX_ALPHA = 1e30
"""Upper bound for |α| and 1/|α|, so that α/R neither overflows nor underflows in fp32."""


class Method(Bottleneck):
    """Base class.

    An additive method implements `init_params`, `down`, `bottleneck`, `up` and `merge`:

        z, aux = bottleneck(bottleneck_params(params), x P),    P = down(params)
        delta = z U,    U = up(params)

    x is [...tokens, I], the kernel W is [I, O], and delta has x's dtype. The parameters of an
    adapter are fp32.
    """

    def __new__(cls, *values: Any, **named: Any) -> "Method":
        """Raise ValueError for an unknown field, where Python would raise TypeError."""
        fields.check_names(cls, name_of(cls), values, named)
        return super().__new__(cls)

    def __post_init__(self) -> None:
        """Raise ValueError for a field of the wrong type or out of range."""
        fields.check_fields(self, maximum=MAX_SIZE)
        alpha = getattr(self, "alpha", None)
        if alpha is not None and not 1 / MAX_ALPHA <= abs(alpha) <= MAX_ALPHA:
            raise ValueError(
                f"|alpha| must be between {1 / MAX_ALPHA:g} and {MAX_ALPHA:g}, got {alpha}"
            )
        if not 0 <= (rate := dropout_rate(self)) < 1:
            raise ValueError(f"dropout must be in [0, 1), got {rate}")

    trains_base: ClassVar[bool] = False
    """True if the method trains the base weights themselves."""
    additive: ClassVar[bool] = True
    """True if the adapted layer computes x @ kernel + delta."""
    is_low_rank_sum: ClassVar[bool] = True
    """True if the layer computes exactly x W + z U; False for a method that overrides `apply`."""

    splits_kernel: ClassVar[bool] = False
    """True if `init` moves part of the kernel into the parameters and returns the residual."""
    down_in_fp32: ClassVar[bool] = False
    """True to keep x P in fp32, whatever the dtype of x."""
    needs_statistics: ClassVar[bool] = False
    """True if `init` requires statistics of the layer's inputs."""

    @property
    def name(self) -> str:
        """Name accepted by `create`."""
        return name_of(type(self))

    @property
    def largest_active_rank(self) -> int:
        """Most directions that a token can use; 0 for a method without a rank."""
        return getattr(self, "rank", 0)

    @property
    def as_saved(self) -> "Method":
        """The method to save with the parameters and to load them with."""
        return self

    def init(
        self, key: jax.Array, kernel: Kernel, *, statistics: Any = None
    ) -> tuple[Params, Kernel]:
        """Initialize parameters for one kernel. The adapted layer initially equals x @ kernel.

        Args:
            key: typed random key.
            kernel: [I, O] array or ShapeDtypeStruct; this implementation uses only its shape.
            statistics: activation statistics, for data-driven initialization.

        Returns:
            The parameters, and the kernel: unchanged, or the residual if the method splits it.

        Raises:
            ValueError: the kernel is not a matrix, or `key` is not a random key.
        """
        del statistics
        fields.check_kernel(kernel)
        return self.init_params(fields.checked_key(key), *kernel.shape), kernel

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """Initialize parameters for a kernel [d_in, d_out]; a pure function of key and shape."""
        raise NotImplementedError

    def trimmed(self, params: Params) -> Params:
        """Zero what a stack's layers do not use of initial parameters `[...layers, ...]`, if any.

        Raises:
            ValueError: the method is for a stack of another size.
        """
        return params

    def unused(self, params: Params) -> int:
        """Number of parameters, or of their shapes, that `trimmed` zeroes; they stay zero."""
        del params
        return 0

    def down(self, params: Params) -> jax.Array:
        """Down-projection P [I, Q]."""
        raise NotImplementedError

    def bottleneck_params(self, params: Params) -> Params:
        """The subset of the parameters that `bottleneck` needs; all of them by default."""
        return params

    def bottleneck(
        self, params: Params, rows: jax.Array, token_mask: Mask
    ) -> tuple[jax.Array, Aux]:
        """Map each token's row of x P to z.

        Args:
            params: from `bottleneck_params`.
            rows: x P, [...tokens, Q] in the dtype of x, or in fp32 if `down_in_fp32`.

        Returns:
            z [...tokens, R], to be multiplied by U, and aux with token_mask unset.
        """
        raise NotImplementedError

    def implementation(self, params: Params) -> Bottleneck:
        """What computes `bottleneck` for these parameters: the method itself, or a fused kernel."""
        del params
        return self

    def up(self, params: Params) -> jax.Array:
        """Up-projection U [R, O]."""
        raise NotImplementedError

    def delta(
        self, params: Params, x: jax.Array, *, token_mask: Mask = None
    ) -> tuple[jax.Array, Aux]:
        """Compute what the adapter adds to x @ kernel, [...tokens, O], and aux.

        Raises:
            ValueError: the method is not additive, x is not floating point, or the parameters
                belong to another method.
        """
        if not self.additive:
            raise ValueError(f"{type(self).__name__} is not additive and has no delta; use apply")
        if not jnp.issubdtype(x.dtype, jnp.floating):
            raise ValueError(f"x must be floating point, got {x.dtype}")
        up = self.up(params).astype(x.dtype)
        check_params(self, params, (x.shape[-1], up.shape[-1]))
        z, aux = self.bottleneck_from_input(params, x, token_mask)
        return z @ up, dataclasses.replace(aux, token_mask=token_mask)

    def bottleneck_from_input(
        self, params: Params, x: jax.Array, token_mask: Mask
    ) -> tuple[jax.Array, Aux]:
        """Compute z [...tokens, R], in the dtype of x, and aux from x itself."""
        down = self.down(params).astype(x.dtype)
        rows = jnp.matmul(x, down, preferred_element_type=self.rows_dtype(x.dtype))
        f = self.implementation(params)
        z, aux = f.bottleneck(self.bottleneck_params(params), rows, token_mask)
        return z.astype(x.dtype), aux

    def apply(
        self, params: Params, x: jax.Array, kernel: jax.Array, *, token_mask: Mask = None
    ) -> tuple[jax.Array, Aux]:
        """Apply the adapted linear layer without its bias: x @ kernel + delta, [...tokens, O].

        `kernel` receives no gradient. Nothing is checked here; `lorasp_jax.dense.dense` does that.
        """
        f, layer = self.implementation(params), self.low_rank_layer(params, kernel)
        ((y, aux),) = low_rank_matmul(f, self.rows_dtype(x.dtype), [layer], x, token_mask)
        return y, dataclasses.replace(aux, token_mask=token_mask)

    def apply_with_dropout(
        self,
        params: Params,
        x: jax.Array,
        kernel: jax.Array,
        key: jax.Array,
        *,
        token_mask: Mask = None,
    ) -> tuple[jax.Array, Aux]:
        """`apply` with dropout: the adapter sees dropout(x), the kernel sees x.

        A method that is not additive (DoRA) has no separate delta. It is applied to dropout(x), and
        (x - dropout(x)) W is added, as in Hugging Face PEFT.

        `key` is a typed random key. See `apply` for the other arguments.
        """
        x_dropped = dropout(x, dropout_rate(self), key)
        if self.additive:
            delta, aux = self.delta(params, x_dropped, token_mask=token_mask)
            return frozen_matmul(x, kernel) + delta, aux
        y, aux = self.apply(params, x_dropped, kernel, token_mask=token_mask)
        return frozen_matmul(x - x_dropped, kernel) + y, aux

    def low_rank_layer(self, params: Params, kernel: jax.Array) -> LowRankLayer:
        """The arrays of one layer for `low_rank_matmul`."""
        bottleneck_params = self.bottleneck_params(params)
        return LowRankLayer(bottleneck_params, kernel, self.down(params), self.up(params))

    def rows_dtype(self, dtype: Any) -> Any:
        """The dtype of x P, for the dtype of x."""
        return jnp.float32 if self.down_in_fp32 else dtype

    def shapes(self, initial: Shapes, actual: Shapes) -> Shapes:
        """The shapes that parameters must have.

        Args:
            initial: shapes from `init_params`, by path.
            actual: shapes of the parameters, which may have been pruned.
        """
        del actual
        return initial

    def penalty(self, params: Params) -> dict[str, jax.Array]:
        """Regularization losses that depend only on the parameters, by name."""
        del params
        return {}

    def transform(
        self, optimizer: optax.GradientTransformation, total_steps: int
    ) -> optax.GradientTransformation:
        """Wrap the optimizer to run the method's own update, if any, in each training step."""
        del total_steps
        return optimizer

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """The kernel [I, O] merged with the adapter, in the kernel's dtype.

        Raises:
            ValueError: the delta depends on the input, so it cannot be merged.
        """
        raise NotImplementedError


def name_of(cls: type[Method]) -> str:
    """The name of a method: its file's, or its folder's if the file is `method.py`."""
    folder, _, file = cls.__module__.rpartition(".")
    return folder.rpartition(".")[2] if file == "method" else file


def dropout_rate(method: Any) -> float:
    """The method's `dropout`, or 0 if it has none."""
    return getattr(method, "dropout", 0.0)


def dropout(x: jax.Array, rate: float, key: jax.Array) -> jax.Array:
    """Zero each entry of x with probability `rate` and scale the others by 1/(1 - rate)."""
    keep = jax.random.bernoulli(key, 1 - rate, x.shape)
    return jnp.where(keep, x / (1 - rate), 0).astype(x.dtype)


def kaiming_uniform(key: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """Sample an [I, R] matrix from U(±1/√I): Kaiming-uniform, a = √5, as in PyTorch and PEFT."""
    bound = shape[0] ** -0.5
    return jax.random.uniform(key, shape, jnp.float32, -bound, bound)


def check_params(method: Method, params: Params, shape: tuple[int, ...]) -> None:
    """Raise ValueError if the parameters do not fit the method and a kernel [I, O].

    Without this check, parameters of a different rank could silently get the wrong scale.
    """
    if type(method).init_params is Method.init_params:
        return  # a method without parameters of its own, such as a set of adapters
    actual = _shapes(params)
    for name, expected in method.shapes(_initial_shapes(method, shape), actual).items():
        if actual.get(name) != expected:
            raise ValueError(
                f"{method.name} for a kernel {list(shape)} needs {name} {list(expected)}, got "
                f"{list(actual[name]) if name in actual else 'none'}"
            )


@functools.lru_cache(maxsize=1024)  # a model's layers share shapes and are traced repeatedly
def _initial_shapes(method: Method, shape: tuple[int, ...]) -> Shapes:
    return _shapes(jax.eval_shape(lambda: method.init_params(jax.random.key(0), *shape)))


def _shapes(params: Params) -> Shapes:
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return {
        jax.tree_util.keystr(path, simple=True, separator="/"): jnp.shape(leaf)
        for path, leaf in leaves
    }
