"""LoRA: ΔW = (α/R) A B of fixed rank (Hu et al., arXiv 2106.09685), with rsLoRA scaling on request.

Conventions and initialisations are those of Hugging Face PEFT: A Kaiming-uniform with a = √5, that
is U(±1/√I), or gaussian, and B = 0; or a part of the kernel, which leaves the rest frozen. Scale
α/R, or α/√R for rsLoRA (Kalajdzievski, arXiv 2312.03732).
"""

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp

from lorasp_jax.peft import _arguments
from lorasp_jax.peft._aux import Aux
from lorasp_jax.peft._method import Kernel, Method, Params, kaiming_uniform

_SPLITS = ("pissa", "olora")


@dataclasses.dataclass(frozen=True)
class LoRA(Method):
    """Fixed-rank adapter.

    Parameters: lora_a [I, R], lora_b [R, O], (I + O) R numbers.

    Raises:
      ValueError: a rank below 1, an unknown initialization, or a dropout outside [0, 1).
    """

    rank: int = 128
    """R; it may exceed the kernel's sides, unless A and B start as parts of the kernel. 128 is the
    paper's main baseline."""
    alpha: float | None = None
    """α; None is 2 R, the scale 2 of LoRA-SP's defaults."""
    rank_stabilized: bool = False
    """Scale by α/√R (rsLoRA) instead of α/R."""
    initialization: Literal["kaiming", "gaussian", "pissa", "olora", "eva"] = "kaiming"
    """"kaiming": A in U(±1/√I). "gaussian": A in N(0, 1/R²). "pissa": A B is the kernel's best
    approximation of rank R (`principal_part`), "olora": the first R columns of its QR
    decomposition (`orthogonal_part`); what trains is then taken out of the kernel. "eva": A spans
    most of what the layer's inputs contain (`principal_inputs`), for which `adapt` needs
    statistics."""
    dropout: float = 0.0
    """Probability with which the adapter sees a number of its input as 0, in training alone:
    `with_dropout` of NNX models, rngs={"dropout": key} of Linen's."""

    def __post_init__(self) -> None:
        """Checks the fields."""
        super().__post_init__()
        if self.rank < 1:
            raise ValueError(f"rank must be at least 1, got {self.rank}.")
        if self.initialization == "pissa" and self.scale < 0:
            raise ValueError(f"'pissa' takes roots of W / scale: alpha {self.alpha} is negative.")

    @property
    def splits_kernel(self) -> bool:
        """True if A and B start as a part of the kernel."""
        return self.initialization in _SPLITS

    @property
    def needs_statistics(self) -> bool:
        """True if A starts from the layer's inputs."""
        return self.initialization == "eva"

    @property
    def scale(self) -> float:
        """α/R, or α/√R when rank-stabilized."""
        alpha = 2 * self.rank if self.alpha is None else self.alpha
        return alpha / (self.rank**0.5 if self.rank_stabilized else self.rank)

    def init(
        self, key: jax.Array, kernel: Kernel, *, statistics: Any = None
    ) -> tuple[Params, Kernel]:
        """A and B, and the kernel, less scale A B where they start as a part of it.

        Arguments and results as for `Method.init`.

        Raises:
          ValueError: the kernel is not a matrix; or, where it is split, it is a shape without
            values or has a side below the rank; or statistics are missing or of another layer.
        """
        if self.needs_statistics:
            _arguments.matrix(kernel)
            a = principal_inputs(statistics, kernel.shape[0], self.rank)
            return {"lora_a": a, "lora_b": jnp.zeros((self.rank, kernel.shape[1]))}, kernel
        if not self.splits_kernel:
            return super().init(key, kernel, statistics=statistics)
        _arguments.matrix(kernel)
        if isinstance(kernel, jax.ShapeDtypeStruct) or self.rank > min(kernel.shape):
            has = "a shape" if isinstance(kernel, jax.ShapeDtypeStruct) else "a kernel"
            raise ValueError(
                f"{self.initialization!r} splits a kernel, so it needs its values and a rank up to "
                f"its smaller side, got rank {self.rank} and {has} {list(kernel.shape)}."
            )
        part = principal_part if self.initialization == "pissa" else orthogonal_part
        a, b = part(kernel.astype(jnp.float32), self.rank, self.scale)
        params = {"lora_a": a, "lora_b": b}
        return params, (kernel.astype(jnp.float32) - self.scale * (a @ b)).astype(kernel.dtype)

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """A random, B zero: the delta starts at exactly zero."""
        shape = (d_in, self.rank)
        gaussian = self.initialization == "gaussian"
        a = jax.random.normal(key, shape) / self.rank if gaussian else kaiming_uniform(key, shape)
        return {"lora_a": a, "lora_b": jnp.zeros((self.rank, d_out))}

    def init_table(
        self, key: jax.Array, table: Kernel, *, statistics: Any = None
    ) -> tuple[Params, Kernel]:
        """Parameters for an embedding [V, D]: A zero, B in N(0, 1), as in Hugging Face PEFT.

        Only the rows of A that were looked up get a gradient, so A is what must start at zero.
        """
        del statistics
        entries, width = table.shape
        b = jax.random.normal(key, (self.rank, width))
        return {"lora_a": jnp.zeros((entries, self.rank)), "lora_b": b}, table

    def down(self, params: Params) -> jax.Array:
        """A."""
        return params["lora_a"]

    def bottleneck(
        self, params: Params, rows: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """Eq. (3) of Hu et al.: z = scale x A; every token uses the whole rank."""
        del params, token_mask
        return self.scale * rows, Aux(jnp.full(rows.shape[:-1], self.rank, jnp.float32))

    def up(self, params: Params) -> jax.Array:
        """B."""
        return params["lora_b"]

    @property
    def as_saved(self) -> "LoRA":
        """The same without "eva", whose statistics are needed for the start alone."""
        if self.needs_statistics:
            return dataclasses.replace(self, initialization="kaiming")
        return self

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """W + scale A B, summed in fp32."""
        delta = self.scale * (params["lora_a"] @ params["lora_b"])
        return (kernel.astype(jnp.float32) + delta).astype(kernel.dtype)


def principal_part(kernel: jax.Array, rank: int, scale: float) -> tuple[jax.Array, jax.Array]:
    """A [I, R] and B [R, O] with scale A B the R largest terms of the kernel's SVD.

    PiSSA (Meng et al., arXiv 2404.02948, eqs. 2-4): the singular values go to both in halves.
    """
    left, values, right = jnp.linalg.svd(kernel, full_matrices=False)
    root = jnp.sqrt(values[:rank] / scale)
    return left[:, :rank] * root, root[:, None] * right[:rank]


def orthogonal_part(kernel: jax.Array, rank: int, scale: float) -> tuple[jax.Array, jax.Array]:
    """A [I, R] and B [R, O], the rows of B orthonormal: QR of the kernel's transpose, cut at R.

    OLoRA (Büyükakyüz, arXiv 2406.01775, algorithm 1), which does not divide by the scale.
    """
    del scale
    orthonormal, triangular = jnp.linalg.qr(kernel.T)
    return triangular[:rank].T, orthonormal[:, :rank].T


def principal_inputs(moment: jax.Array | None, d_in: int, rank: int) -> jax.Array:
    """A [I, R]: the R leading right singular vectors of the stacked inputs x [T, I].

    EVA (Paischer et al., arXiv 2410.07170, section 3.1), without its redistribution of ranks; as
    eigenvectors of Σ x xᵀ, which is summed over batches.

    Args:
      moment: Σ x xᵀ, [I, I], not centred.
      d_in: I.
      rank: R, at most I.

    Raises:
      ValueError: no moment, one of another layer, or a rank above I.
    """
    if moment is None:
        raise ValueError(
            "initialization 'eva' needs the inputs' statistics: pass those of "
            "calibration.input_moments to adapt."
        )
    if moment.shape != (d_in, d_in) or rank > d_in:
        raise ValueError(
            f"initialization 'eva' needs statistics [{d_in}, {d_in}] and a rank up to {d_in}, got "
            f"{list(moment.shape)} and {rank}."
        )
    _, vectors = jnp.linalg.eigh(moment.astype(jnp.float32))
    return vectors[:, ::-1][:, :rank]
