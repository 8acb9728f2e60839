"""Sizes of pi0. One code serves all of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from lorasp_jax.models.tokenizer import VOCABULARY_SIZE

if TYPE_CHECKING:
    from flax import nnx

    from lorasp_jax.models.pi0.pi0 import Pi0


@dataclass(frozen=True)
class VisionConfig:
    """Size of the SigLIP tower."""

    width: int
    depth: int
    mlp: int
    heads: int
    patch: int
    """Height and width of a patch [pixels]."""


@dataclass(frozen=True)
class ExpertConfig:
    """Size of one Gemma expert; both experts agree in depth, heads, kv_heads and head_dim."""

    width: int
    depth: int
    mlp: int
    heads: int
    kv_heads: int
    head_dim: int


@dataclass(frozen=True)
class Pi0Config:
    """Every size of a pi0.

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
    dtype: str = "float32"
    """Type of the towers' matrix products; norms, softmax, projections and the loss are fp32."""
    param_dtype: str = "float32"
    """Type the parameters are stored in."""
    remat: bool = False
    """Recompute each layer's inside in the backward pass: less memory, a third more work."""
    unroll: bool = False
    """Straight-line code instead of a loop over layers: faster for a few small ones (a loop copies
    what the backward pass needs into stacks and out again), at the price of compile time."""

    def __post_init__(self) -> None:
        """Checks that the parts fit."""
        language, action = self.language, self.action
        for name in ("depth", "heads", "kv_heads", "head_dim"):
            a, b = getattr(language, name), getattr(action, name)
            if a != b:
                raise ValueError(f"experts share attention, but {name} is {a} and {b}.")
        if self.image_size % self.vision.patch:
            raise ValueError(
                f"image_size {self.image_size} is not a multiple of the patch, {self.vision.patch}."
            )
        if self.vision.width % self.vision.heads or language.heads % language.kv_heads:
            raise ValueError("heads must divide the vision width, kv_heads the experts' heads.")
        if language.head_dim % 2 or action.width % 2:
            raise ValueError("head_dim and the action width must be even.")

    @property
    def image_tokens(self) -> int:
        """Tokens per camera."""
        return (self.image_size // self.vision.patch) ** 2

    def create(self, rngs: nnx.Rngs) -> Pi0:
        """A model with random weights; works under `nnx.eval_shape`."""
        from lorasp_jax.models.pi0.pi0 import Pi0

        return Pi0(self, rngs=rngs)

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> Pi0Config:
        """The config of `dataclasses.asdict`, also after JSON.

        Raises:
            TypeError, KeyError: missing or unknown fields.
        """
        parts = {
            "vision": VisionConfig(**fields["vision"]),
            "language": ExpertConfig(**fields["language"]),
            "action": ExpertConfig(**fields["action"]),
            "cameras": tuple(fields["cameras"]),
        }
        return cls(**{**fields, **parts})

    @classmethod
    def base(cls) -> Pi0Config:
        """The published pi0, 3,238,048,528 parameters (openpi, models/{gemma,siglip}.py)."""
        return cls(
            vision=VisionConfig(width=1152, depth=27, mlp=4304, heads=16, patch=14),
            language=ExpertConfig(2048, 18, 16384, heads=8, kv_heads=1, head_dim=256),
            action=ExpertConfig(1024, 18, 4096, heads=8, kv_heads=1, head_dim=256),
            cameras=("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb"),
            image_size=224,
            vocabulary=257_152,
            max_tokens=48,
            chunk=50,
            action_dim=32,
            dtype="bfloat16",
        )

    @classmethod
    def small(cls) -> Pi0Config:
        """For one accelerator: about 9.5 M parameters, 64 tokens a camera."""
        return cls(
            vision=VisionConfig(width=256, depth=4, mlp=768, heads=4, patch=8),
            language=ExpertConfig(192, 6, 512, heads=8, kv_heads=1, head_dim=32),
            action=ExpertConfig(256, 6, 768, heads=8, kv_heads=1, head_dim=32),
            cameras=("side", "wrist"),
            image_size=64,
            vocabulary=VOCABULARY_SIZE,
            max_tokens=10,
            chunk=10,
            action_dim=8,
            unroll=True,
        )

    @classmethod
    def nano(cls) -> Pi0Config:
        """For a CPU: about 1 M parameters, 16 tokens a camera."""
        return cls(
            vision=VisionConfig(width=96, depth=2, mlp=256, heads=3, patch=16),
            language=ExpertConfig(96, 3, 192, heads=4, kv_heads=1, head_dim=32),
            action=ExpertConfig(128, 3, 256, heads=4, kv_heads=1, head_dim=32),
            cameras=("side", "wrist"),
            image_size=64,
            vocabulary=VOCABULARY_SIZE,
            max_tokens=10,
            chunk=10,
            action_dim=8,
            unroll=True,
        )

    @classmethod
    def dummy(cls) -> Pi0Config:
        """For tests: compiles and runs in seconds."""
        return cls(
            vision=VisionConfig(width=32, depth=2, mlp=48, heads=2, patch=16),
            language=ExpertConfig(48, 2, 64, heads=4, kv_heads=2, head_dim=16),
            action=ExpertConfig(32, 2, 64, heads=4, kv_heads=2, head_dim=16),
            cameras=("side", "wrist"),
            image_size=32,
            vocabulary=VOCABULARY_SIZE,
            max_tokens=6,
            chunk=4,
            action_dim=8,
        )
