"""LoRA: ΔW = scale A B of fixed rank R (Hu et al., arXiv 2106.09685).

The scale is α/R, or α/√R for rsLoRA (Kalajdzievski, arXiv 2312.03732). Conventions and
initializations follow Hugging Face PEFT.
"""

import dataclasses
import math
from typing import Any, Literal

import jax
import jax.numpy as jnp

from lorasp_jax.peft.auxiliary import Aux
from lorasp_jax.peft.fields import at_least, check_kernel, short
from lorasp_jax.peft.method import Kernel, Mask, Method, Params, kaiming_uniform


@dataclasses.dataclass(frozen=True)
class LoRA(Method):
    """Fixed-rank adapter.

    Parameters: lora_a [I, R], lora_b [R, O]: (I + O) R in total.

    Raises:
        ValueError: a rank below 1, an unknown initialization, or a dropout outside [0, 1).
    """

    rank: int = 128
    """R. It must be at most min(I, O) for "pissa" and "olora", and at most I for "eva". The LoRA-SP
    paper's main baseline has rank 128."""
    alpha: float | None = None
    """α. None: 2 R, so α/R is 2, as in LoRA-SP."""
    rank_stabilized: bool = False
    """Scale by α/√R (rsLoRA) instead of α/R."""
    initialization: Literal["kaiming", "gaussian", "pissa", "olora", "eva"] = "kaiming"
    """Initial A and B. "kaiming": A from U(±1/√I), B = 0. "gaussian": A from N(0, 1/R²), B = 0.
    "pissa": scale A B is the best rank-R approximation of the kernel (`principal_part`). "olora":
    A B is from a QR decomposition of the kernel's transpose, truncated to rank R
    (`orthogonal_part`). Both leave the residual W - scale A B in the kernel. "eva": A spans the
    principal directions of the layer's inputs (`principal_inputs`), B = 0; `adapt` then needs
    `statistics`."""
    dropout: float = 0.0
    """Dropout rate on the adapter's input, in training only. Enable it with `with_dropout` (NNX) or
    rngs={"dropout": key} (Linen)."""
    ranks: tuple[int, ...] = ()
    """Ranks r ≤ R of the layers of a stack, of which `adapt` needs one per layer; empty: all have
    rank R. A plan sets them (`lorasp_jax.peft.plan`). A direction beyond a layer's rank has A and B
    zero, hence no gradient, and stays zero. The scale is that of R in all layers."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(1, self, "rank")
        if self.ranks and not (min(self.ranks) >= 0 and 1 <= max(self.ranks) <= self.rank):
            raise ValueError(
                f"ranks must be from 0 to rank {self.rank}, not all 0, got {short(self.ranks)}"
            )
        if self.ranks and self.initialization not in ("kaiming", "eva"):
            raise ValueError(
                f"initialization must be 'kaiming' or 'eva' if ranks differ by layer, since "
                f"{self.initialization!r} depends on the rank, got {short(self.ranks)}"
            )
        if self.initialization == "pissa" and self.scale < 0:
            raise ValueError(f"alpha must be positive for 'pissa', got {self.alpha}")

    @property
    def splits_kernel(self) -> bool:
        """True if the initial A B is split off the kernel."""
        return self.initialization in ("pissa", "olora")

    @property
    def needs_statistics(self) -> bool:
        """True if A is initialized from the layer's inputs."""
        return self.initialization == "eva"

    @property
    def scale(self) -> float:
        """α/R, or α/√R when rank-stabilized."""
        alpha = 2 * self.rank if self.alpha is None else self.alpha
        return alpha / (self.rank**0.5 if self.rank_stabilized else self.rank)

    def init(
        self, key: jax.Array, kernel: Kernel, *, statistics: Any = None
    ) -> tuple[Params, Kernel]:
        """Initialize A and B; if they are split off the kernel, return the residual W - scale A B.

        See `Method.init` for the arguments and results.

        Raises:
            ValueError: `Method.init` rejects an argument. For "pissa" and "olora": the kernel has
                no values, or R > min(I, O). For "eva": statistics are missing or have the wrong
                shape, or R > I.
        """
        if self.needs_statistics:
            check_kernel(kernel)
            a = principal_inputs(statistics, kernel.shape[0], self.rank)
            return {"lora_a": a, "lora_b": jnp.zeros((self.rank, kernel.shape[1]))}, kernel
        if not self.splits_kernel:
            return super().init(key, kernel, statistics=statistics)
        check_kernel(kernel)
        if isinstance(kernel, jax.ShapeDtypeStruct) or self.rank > min(kernel.shape):
            given = "a shape" if isinstance(kernel, jax.ShapeDtypeStruct) else "a kernel"
            raise ValueError(
                f"initialization {self.initialization!r} needs the kernel's values and a rank of "
                f"at most min(I, O), got rank {self.rank} and {given} {list(kernel.shape)}"
            )
        exact = kernel.astype(jnp.float32)
        if self.initialization == "pissa":
            a, b = principal_part(exact, self.rank, self.scale)
        else:
            a, b = orthogonal_part(exact, self.rank)
        residual = (exact - self.scale * (a @ b)).astype(kernel.dtype)
        return {"lora_a": a, "lora_b": b}, residual

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """Initialize A randomly and B to zero; the delta is exactly zero."""
        shape = (d_in, self.rank)
        gaussian = self.initialization == "gaussian"
        a = jax.random.normal(key, shape) / self.rank if gaussian else kaiming_uniform(key, shape)
        return {"lora_a": a, "lora_b": jnp.zeros((self.rank, d_out))}

    def init_table(
        self, key: jax.Array, table: Kernel, *, statistics: Any = None
    ) -> tuple[Params, Kernel]:
        """Initialize parameters for an embedding table: A zero, B from N(0, 1), as in PEFT.

        Rows of A that are never looked up receive no gradient and stay zero, so the embeddings of
        their tokens do not change.
        """
        del statistics
        entries, width = table.shape
        b = jax.random.normal(key, (self.rank, width))
        return {"lora_a": jnp.zeros((entries, self.rank)), "lora_b": b}, table

    def down(self, params: Params) -> jax.Array:
        """A."""
        return params["lora_a"]

    def bottleneck(
        self, params: Params, rows: jax.Array, token_mask: Mask
    ) -> tuple[jax.Array, Aux]:
        """Eq. (3) of Hu et al.: z = scale x A. Every token uses the layer's full rank."""
        del token_mask
        if not self.ranks:
            return self.scale * rows, Aux(jnp.full(rows.shape[:-1], self.rank, jnp.float32))
        rank = (params["lora_a"] != 0).any(0).sum().astype(jnp.float32)
        return self.scale * rows, Aux(jnp.broadcast_to(rank, rows.shape[:-1]))

    def up(self, params: Params) -> jax.Array:
        """B."""
        return params["lora_b"]

    def trimmed(self, params: Params) -> Params:
        """Zero the directions beyond the `ranks` of the layers; see `Method.trimmed`."""
        if not self.ranks:
            return params
        *stack, _, rank = params["lora_a"].shape
        if len(self.ranks) != math.prod(stack):
            raise ValueError(
                f"ranks must have one entry for each layer of the stack ({math.prod(stack)}), got "
                f"{len(self.ranks)}"
            )
        live = jnp.arange(rank) < jnp.array(self.ranks).reshape(*stack, 1)
        # Not a product with the mask, which would leave negative zeros.
        a = jnp.where(live[..., None, :], params["lora_a"], 0)
        b = jnp.where(live[..., None], params["lora_b"], 0)
        return {**params, "lora_a": a, "lora_b": b}

    def unused(self, params: Params) -> int:
        """Number of parameters of the directions beyond `ranks`; see `Method.unused`."""
        width = params["lora_a"].shape[-2] + params["lora_b"].shape[-1]
        return sum(self.rank - rank for rank in self.ranks) * width

    @property
    def as_saved(self) -> "LoRA":
        """The method with "kaiming" instead of "eva", so that loading needs no statistics."""
        if self.needs_statistics:
            return dataclasses.replace(self, initialization="kaiming")
        return self

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """W + scale A B, summed in fp32."""
        delta = self.scale * (params["lora_a"] @ params["lora_b"])
        return (kernel.astype(jnp.float32) + delta).astype(kernel.dtype)


def principal_part(kernel: jax.Array, rank: int, scale: float) -> tuple[jax.Array, jax.Array]:
    """A [I, R] and B [R, O] such that scale A B is the kernel's SVD truncated to rank R.

    PiSSA (Meng et al., arXiv 2404.02948, eqs. 2-4): each factor gets the square root of the
    singular values.
    """
    left, values, right = jnp.linalg.svd(kernel, full_matrices=False)
    root = jnp.sqrt(values[:rank] / scale)
    return left[:, :rank] * root, root[:, None] * right[:rank]


def orthogonal_part(kernel: jax.Array, rank: int) -> tuple[jax.Array, jax.Array]:
    """A [I, R] and B [R, O] from a rank-R QR of the kernel's transpose; B's rows are orthonormal.

    As in OLoRA (Büyükakyüz, arXiv 2406.01775, algorithm 1), A B does not depend on the scale.
    """
    orthonormal, triangular = jnp.linalg.qr(kernel.T)
    return triangular[:rank].T, orthonormal[:, :rank].T


def principal_inputs(moment: jax.Array | None, d_in: int, rank: int) -> jax.Array:
    """A [I, R]: the R leading right singular vectors of the stacked inputs x [T, I].

    EVA (Paischer et al., arXiv 2410.07170, section 3.1), without its redistribution of ranks. The
    vectors are computed as eigenvectors of Σ x xᵀ, which can be summed over batches.

    Args:
        moment: Σ x xᵀ, [I, I], not centered.
        d_in: I.
        rank: R, at most I.

    Raises:
        ValueError: the moment is missing or has the wrong shape, or R exceeds I.
    """
    if moment is None:
        raise ValueError(
            "initialization 'eva' needs statistics of the inputs: pass the result of "
            "`input_moments` to `adapt`"
        )
    if moment.shape != (d_in, d_in) or rank > d_in:
        raise ValueError(
            f"initialization 'eva' needs statistics [{d_in}, {d_in}] and a rank of at most {d_in}, "
            f"got {list(moment.shape)} and {rank}"
        )
    _, vectors = jnp.linalg.eigh(moment.astype(jnp.float32))
    return vectors[:, ::-1][:, :rank]
