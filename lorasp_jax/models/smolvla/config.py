"""Sizes of SmolVLA. One code serves all of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from lorasp_jax.models.config import BackboneConfig, ExpertConfig, VisionConfig
from lorasp_jax.models.inputs import LEROBOT

if TYPE_CHECKING:
    from flax import nnx

    from lorasp_jax.models.smolvla.smolvla import SmolVLA


@dataclass(frozen=True)
class SmolVLAConfig(BackboneConfig):
    """Every size of a SmolVLA.

    Raises:
        ValueError: sizes that do not fit together.
    """

    def __post_init__(self) -> None:
        """Checks that the parts fit."""
        super().__post_init__()
        if self.action.depth % 2:
            raise ValueError(
                "self- and cross-attention alternate, so the depth must be even, "
                f"not {self.action.depth}."
            )

    def create(self, rngs: nnx.Rngs) -> SmolVLA:
        """A model with random weights; works under `nnx.eval_shape`."""
        from lorasp_jax.models.smolvla.smolvla import SmolVLA

        return SmolVLA(self, rngs=rngs)

    @classmethod
    def base(cls) -> SmolVLAConfig:
        """The published SmolVLA, 450,046,176 parameters (LeRobot, policies/smolvla).

        The action expert has 3/4 of the language model's width, 720, and an MLP of
        256 ceil(int(4 int(2 * 720 / 3)) / 256) = 2048 (its smolvlm_with_expert.py).
        """
        return cls(
            vision=VisionConfig(width=768, depth=12, mlp=3072, heads=12, patch=16, shuffle=4),
            language=ExpertConfig(960, 16, 2560, heads=15, kv_heads=5, head_dim=64),
            action=ExpertConfig(720, 16, 2048, heads=15, kv_heads=5, head_dim=64),
            cameras=("camera1", "camera2", "camera3"),
            image_size=512,
            vocabulary=49_280,
            max_tokens=48,
            chunk=50,
            action_dim=32,
            inputs=LEROBOT,
            dtype="bfloat16",
        )

    @classmethod
    def small(cls) -> SmolVLAConfig:
        """For one accelerator: about 9 M parameters, 16 tokens a camera of 64 patches."""
        return cls.miniature(
            vision=VisionConfig(width=256, depth=4, mlp=768, heads=4, patch=8, shuffle=2),
            language=ExpertConfig(256, 6, 640, heads=6, kv_heads=2, head_dim=32),
            action=ExpertConfig(192, 6, 512, heads=6, kv_heads=2, head_dim=32),
        )

    @classmethod
    def nano(cls) -> SmolVLAConfig:
        """For a CPU: about 1 M parameters, 16 tokens a camera."""
        return cls.miniature(
            vision=VisionConfig(width=96, depth=2, mlp=256, heads=3, patch=8, shuffle=2),
            language=ExpertConfig(96, 4, 192, heads=3, kv_heads=1, head_dim=32),
            action=ExpertConfig(96, 4, 256, heads=3, kv_heads=1, head_dim=32),
        )

    @classmethod
    def dummy(cls) -> SmolVLAConfig:
        """For tests: compiles and runs in seconds."""
        return cls.miniature(
            vision=VisionConfig(width=32, depth=2, mlp=48, heads=2, patch=8, shuffle=2),
            language=ExpertConfig(48, 4, 64, heads=4, kv_heads=2, head_dim=16),
            action=ExpertConfig(32, 4, 64, heads=4, kv_heads=2, head_dim=16),
            image_size=32,
            max_tokens=6,
            chunk=4,
            unroll=False,
        )
