"""Sizes that every backbone has."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal, Self

import jax.numpy as jnp

from lorasp_jax.models.inputs import OURS, InputConfig
from lorasp_jax.peft import _fields

VOCABULARY_SIZE = 320
"""Rows of the embedding table of our own bases, those of reserved words included."""

Remat = Literal["none", "products", "full"]
_LARGEST = 2**24
"""Of any size, far beyond every model there is: what a file says is bounded before it is used."""
_DEEPEST = 1000


def _check_sizes(part: Any) -> None:
    """Raise ValueError where a size is not a positive whole number, or is absurd."""
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        largest = _DEEPEST if field.name == "depth" else _LARGEST
        if field.type == "int" and not (type(value) is int and 0 < value <= largest):
            raise ValueError(
                f"{field.name} must be a whole number from 1 to {largest}, not {value!r}."
            )


@dataclass(frozen=True)
class VisionConfig:
    """Size of the SigLIP tower."""

    width: int
    depth: int
    mlp: int
    heads: int
    patch: int
    """Height and width of a patch [pixels]."""
    shuffle: int = 1
    """Height and width of the square of tokens that the head reads as one [tokens]."""

    def __post_init__(self) -> None:
        """Checks the sizes."""
        _check_sizes(self)

    @property
    def matrices(self) -> tuple[int, ...]:
        """What the shapes of the matrices tell, heads left out."""
        return self.width, self.depth, self.mlp, self.patch, self.shuffle


@dataclass(frozen=True)
class ExpertConfig:
    """Size of one expert; both experts agree in depth, heads, kv_heads and head_dim."""

    width: int
    depth: int
    mlp: int
    heads: int
    kv_heads: int
    head_dim: int

    def __post_init__(self) -> None:
        """Checks the sizes."""
        _check_sizes(self)

    @property
    def matrices(self) -> tuple[int, ...]:
        """What the shapes of the matrices tell: heads and their size only as a product."""
        inner, context = self.heads * self.head_dim, self.kv_heads * self.head_dim
        return self.width, self.depth, self.mlp, inner, context


@dataclass(frozen=True)
class BackboneConfig:
    """Every size of a backbone.

    Raises:
        ValueError: sizes that do not fit together.
    """

    vision: VisionConfig
    language: ExpertConfig
    action: ExpertConfig
    cameras: tuple[str, ...]
    """Names of the pictures, in the order of their tokens."""
    image_size: int
    """Height and width of the pictures [pixels]."""
    vocabulary: int
    """Rows of the embedding table."""
    max_tokens: int
    """Length of the padded instruction."""
    chunk: int
    """Actions per chunk, C."""
    action_dim: int
    """Slots of state and action vectors, A."""
    inputs: InputConfig = OURS
    """How pictures, states and actions are prepared."""
    dtype: str = "float32"
    """Type of the towers' matrix products; norms, softmax, projections and the loss are fp32."""
    param_dtype: str = "float32"
    """Type the parameters are stored in."""
    remat: Remat = "none"
    """What the backward pass computes again: nothing; all but the results of matrix products
    ("products": half the memory, a few percent more work); everything inside a layer ("full": the
    least memory, a third more work)."""
    unroll: bool | None = None
    """Straight-line code instead of a loop over layers: faster, the most for small ones (a loop
    copies what the backward pass needs into stacks and out again), but two to three times as long
    to compile. None: unless `remat` is "full", of which XLA keeps to the order in a loop alone."""

    def __post_init__(self) -> None:
        """Checks that the parts fit."""
        _check_sizes(self)
        language, action = self.language, self.action
        for name in ("depth", "heads", "kv_heads", "head_dim"):
            a, b = getattr(language, name), getattr(action, name)
            if a != b:
                raise ValueError(f"experts share attention, but {name} is {a} and {b}.")
        side = self.vision.patch * self.vision.shuffle
        if self.image_size % side:
            raise ValueError(
                f"image_size {self.image_size} is not a multiple of the patch, {side}."
            )
        if self.vision.width % self.vision.heads or language.heads % language.kv_heads:
            raise ValueError("heads must divide the vision width, kv_heads the experts' heads.")
        if language.head_dim % 2 or action.width % 2:
            raise ValueError("head_dim and the action width must be even.")

    @classmethod
    def miniature(
        cls,
        vision: VisionConfig,
        language: ExpertConfig,
        action: ExpertConfig,
        *,
        image_size: int = 64,
        max_tokens: int = 10,
        chunk: int = 10,
        unroll: bool | None = None,
    ) -> Self:
        """A config for simulation: its two cameras, the offline tokenizer's words, a robot arm."""
        return cls(
            vision,
            language,
            action,
            cameras=("side", "wrist"),
            image_size=image_size,
            vocabulary=VOCABULARY_SIZE,
            max_tokens=max_tokens,
            chunk=chunk,
            action_dim=8,
            unroll=unroll,
        )

    @property
    def straight_line(self) -> bool:
        """Whether layers are straight-line code."""
        return self.remat != "full" if self.unroll is None else self.unroll

    @property
    def patches(self) -> int:
        """Patches per camera."""
        return (self.image_size // self.vision.patch) ** 2

    @property
    def image_tokens(self) -> int:
        """Tokens per camera."""
        return self.patches // self.vision.shuffle**2

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> Self:
        """The config of `dataclasses.asdict`, also after JSON.

        Raises:
            TypeError, KeyError: missing or unknown fields, or types of arrays that there are not.
            ValueError: values of other kinds than the fields'.
        """
        inputs = fields.get("inputs", {}) if isinstance(fields, dict) else None
        if not isinstance(inputs, dict):
            raise TypeError("a config and its inputs are objects")
        parts = {
            "vision": VisionConfig(**fields["vision"]),
            "language": ExpertConfig(**fields["language"]),
            "action": ExpertConfig(**fields["action"]),
            "cameras": tuple(fields["cameras"]),
            "inputs": InputConfig(**{**inputs, "delta": tuple(inputs.get("delta", ()))}),
        }
        config = cls(**{**fields, **parts})
        _fields.check_fields(config)
        _fields.check_fields(config.inputs, "inputs.")
        for name in (config.dtype, config.param_dtype):
            jnp.dtype(name)  # raises TypeError
        return config
