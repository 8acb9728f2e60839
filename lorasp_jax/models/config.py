"""Model sizes and runtime options shared by all backbones."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal, Self

import jax.numpy as jnp

from lorasp_jax.models.inputs import OURS, InputConfig
from lorasp_jax.peft.fields import check_fields

VOCABULARY_SIZE = 320
"""Rows of the embedding table in this project's base models, including reserved tokens."""

Remat = Literal["none", "products", "narrow", "full"]
_MAX_SIZE = 2**24
"""Upper bound for sizes, far beyond existing models; rejects absurd values in config files."""
_MAX_DEPTH = 1000


def _check_sizes(config: Any) -> None:
    """Raise ValueError if a size is not a positive integer or is implausibly large."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        limit = _MAX_DEPTH if field.name == "depth" else _MAX_SIZE
        if field.type == "int" and not (type(value) is int and 0 < value <= limit):
            raise ValueError(f"{field.name} must be an integer from 1 to {limit}, got {value!r}")


@dataclass(frozen=True)
class VisionConfig:
    """Sizes of the SigLIP tower."""

    width: int
    depth: int
    mlp: int
    heads: int
    patch: int
    """Side of a patch [pixels]."""
    shuffle: int = 1
    """Pixel shuffle merges each `shuffle` x `shuffle` square of tokens into one token."""

    def __post_init__(self) -> None:
        _check_sizes(self)

    @property
    def kernel_sizes(self) -> tuple[int, ...]:
        """Sizes that determine kernel shapes; the number of heads does not."""
        return self.width, self.depth, self.mlp, self.patch, self.shuffle


@dataclass(frozen=True)
class ExpertConfig:
    """Sizes of one expert. Depth, heads, kv_heads and head_dim must be equal for both experts."""

    width: int
    depth: int
    mlp: int
    heads: int
    kv_heads: int
    head_dim: int

    def __post_init__(self) -> None:
        _check_sizes(self)

    @property
    def kernel_sizes(self) -> tuple[int, ...]:
        """Sizes that determine kernel shapes; head counts and head_dim enter only as products."""
        inner, context = self.heads * self.head_dim, self.kv_heads * self.head_dim
        return self.width, self.depth, self.mlp, inner, context


@dataclass(frozen=True)
class BackboneConfig:
    """Sizes and runtime options of a backbone.

    Raises:
        ValueError: inconsistent sizes.
    """

    vision: VisionConfig
    language: ExpertConfig
    action: ExpertConfig
    cameras: tuple[str, ...]
    """Camera names, in token order."""
    image_size: int
    """Height and width of the images [pixels]."""
    vocabulary: int
    """Rows of the embedding table."""
    max_tokens: int
    """Length of the padded instruction."""
    chunk: int
    """Actions per chunk, C."""
    action_dim: int
    """Number of slots in state and action vectors, A."""
    inputs: InputConfig = OURS
    """Preprocessing of images, states and actions."""
    dtype: str = "float32"
    """Dtype of the towers' matmuls; norms, softmax, projections and the loss run in fp32."""
    param_dtype: str = "float32"
    """Dtype of the stored parameters."""
    remat: Remat = "none"
    """Rematerialization in the backward pass. "none" recomputes nothing. "products" recomputes all
    but products with weights: half the memory, a few percent more compute. "narrow" also recomputes
    products with more than twice the columns of their input, as in MLPs. "full" recomputes whole
    layers: the least memory, a third more compute."""
    unroll: bool | None = None
    """Unroll the loop over layers. Compilation takes two to three times as long, but training runs
    faster, especially with small layers: a loop copies residuals into and out of stacked arrays.
    None unrolls unless `remat` is "full", because XLA preserves the order of rematerialization only
    inside a loop."""

    def __post_init__(self) -> None:
        _check_sizes(self)
        vision, language, action = self.vision, self.language, self.action
        shared = [(e.depth, e.heads, e.kv_heads, e.head_dim) for e in (language, action)]
        rules = {
            "depth, heads, kv_heads and head_dim of both experts must be equal": (
                shared[0] == shared[1]
            ),
            "image_size must be a multiple of vision.patch * vision.shuffle": (
                self.image_size % (vision.patch * vision.shuffle) == 0
            ),
            "vision.width must be a multiple of vision.heads": vision.width % vision.heads == 0,
            "heads must be a multiple of kv_heads": language.heads % language.kv_heads == 0,
            "head_dim and action.width must be even": (
                language.head_dim % 2 == action.width % 2 == 0
            ),
        }
        for rule, holds in rules.items():
            if not holds:
                raise ValueError(rule)

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
        """Create a config for simulation: two cameras, offline tokenizer, one robot arm."""
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
    def unroll_layers(self) -> bool:
        """Whether to unroll the loop over layers; resolves `unroll=None`."""
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
        """Inverse of `dataclasses.asdict`, also after a JSON round trip.

        Raises:
            TypeError, KeyError: missing or unknown fields, or an unknown dtype.
            ValueError: a value of the wrong type, or inconsistent sizes.
        """
        inputs = fields.get("inputs", {})
        nested = {
            "vision": VisionConfig(**fields["vision"]),
            "language": ExpertConfig(**fields["language"]),
            "action": ExpertConfig(**fields["action"]),
            "cameras": tuple(fields["cameras"]),
            "inputs": InputConfig(**{**inputs, "delta": tuple(inputs.get("delta", ()))}),
        }
        config = cls(**{**fields, **nested})
        check_fields(config)
        check_fields(config.inputs, "inputs.")
        for name in (config.dtype, config.param_dtype):
            jnp.dtype(name)  # raises TypeError for an unknown dtype
        return config
