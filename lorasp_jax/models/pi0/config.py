"""Sizes of pi0. One code serves all of them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lorasp_jax.models.config import BackboneConfig, ExpertConfig, VisionConfig
from lorasp_jax.models.inputs import OPENPI, OPENPI_PI05, OURS_PI05

if TYPE_CHECKING:
    from flax import nnx

    from lorasp_jax.models.pi0.pi0 import Pi0


@dataclass(frozen=True)
class Pi0Config(BackboneConfig):
    """Every size of a pi0, or of a pi0.5."""

    pi05: bool = False
    """pi0.5: the flow time reaches the action expert through its norms, not through the tokens, and
    there is no token of the state, which the prompt tells instead."""

    def create(self, rngs: nnx.Rngs) -> Pi0:
        """A model with random weights; works under `nnx.eval_shape`."""
        from lorasp_jax.models.pi0.pi0 import Pi0, Pi05

        return (Pi05 if self.pi05 else Pi0)(self, rngs=rngs)

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
            inputs=OPENPI,
            dtype="bfloat16",
        )

    @classmethod
    def base_pi05(cls) -> Pi0Config:
        """The published pi0.5, 3,353,433,872 parameters (openpi, models/pi0_config.py)."""
        return dataclasses.replace(cls.base(), pi05=True, max_tokens=200, inputs=OPENPI_PI05)

    @classmethod
    def small(cls) -> Pi0Config:
        """For one accelerator: about 9.5 M parameters, 64 tokens a camera."""
        return cls.miniature(
            vision=VisionConfig(width=256, depth=4, mlp=768, heads=4, patch=8),
            language=ExpertConfig(192, 6, 512, heads=8, kv_heads=1, head_dim=32),
            action=ExpertConfig(256, 6, 768, heads=8, kv_heads=1, head_dim=32),
        )

    @classmethod
    def nano(cls) -> Pi0Config:
        """For a CPU: about 1 M parameters, 16 tokens a camera."""
        return cls.miniature(
            vision=VisionConfig(width=96, depth=2, mlp=256, heads=3, patch=16),
            language=ExpertConfig(96, 3, 192, heads=4, kv_heads=1, head_dim=32),
            action=ExpertConfig(128, 3, 256, heads=4, kv_heads=1, head_dim=32),
        )

    @classmethod
    def nano_pi05(cls) -> Pi0Config:
        """pi0.5 for a CPU; the offline tokenizer's prompts with a robot's state fit."""
        return dataclasses.replace(cls.nano(), pi05=True, max_tokens=64, inputs=OURS_PI05)

    @classmethod
    def dummy(cls) -> Pi0Config:
        """For tests: compiles and runs in seconds."""
        return cls.miniature(
            vision=VisionConfig(width=32, depth=2, mlp=48, heads=2, patch=16),
            language=ExpertConfig(48, 2, 64, heads=4, kv_heads=2, head_dim=16),
            action=ExpertConfig(32, 2, 64, heads=4, kv_heads=2, head_dim=16),
            image_size=32,
            max_tokens=6,
            chunk=4,
            unroll=False,
        )
