"""The workloads that all programs share, and the batch that all of them get.

This module needs only NumPy, because it is imported in every program's own environment.
"""

import dataclasses
from typing import Any, Literal

import numpy as np

Size = Literal["base", "tiny"]
"""The published sizes, or sizes that run on a CPU in seconds."""


@dataclasses.dataclass(frozen=True)
class Policy:
    """Input shapes of a vision-language-action model."""

    batch: int
    """Samples per training step."""
    cameras: int
    image: int
    """Height and width of the images [pixels]."""
    tokens: int
    """Length of the instruction."""
    chunk: int
    """Actions per chunk."""
    dim: int
    """Slots in states and actions."""
    rank: int
    """Rank of the adapters on all linear layers."""
    sampled: tuple[int, ...]
    """Batch sizes for sampling."""


@dataclasses.dataclass(frozen=True)
class Layers:
    """Single dense layers."""

    shapes: tuple[tuple[int, int], ...]
    """Kernels [inputs, outputs]."""
    tokens: int
    rank: int


@dataclasses.dataclass(frozen=True)
class Stack:
    """A sequence of square dense layers."""

    depth: int
    width: int
    tokens: int
    rank: int


PI0: dict[Size, Policy] = {
    "base": Policy(32, 3, 224, 48, 50, 32, 128, (1, 8)),
    "tiny": Policy(2, 3, 32, 8, 4, 8, 4, (1, 2)),
}
SMOLVLA: dict[Size, Policy] = {
    "base": Policy(32, 2, 512, 48, 50, 32, 128, (1, 8)),
    "tiny": Policy(2, 2, 32, 8, 4, 8, 4, (1, 2)),
}
SMOLVLA_TOWERS: dict[Size, dict[str, dict[str, int]]] = {
    "base": {
        "text": {
            "hidden_size": 960,
            "intermediate_size": 2560,
            "num_hidden_layers": 16,
            "num_attention_heads": 15,
            "num_key_value_heads": 5,
            "head_dim": 64,
            "vocab_size": 49_280,
        },
        "vision": {
            "hidden_size": 768,
            "intermediate_size": 3072,
            "num_hidden_layers": 12,
            "num_attention_heads": 12,
            "patch_size": 16,
        },
        "model": {"scale_factor": 4},
    },
    "tiny": {
        "text": {
            "hidden_size": 64,
            "intermediate_size": 128,
            "num_hidden_layers": 4,
            "num_attention_heads": 4,
            "num_key_value_heads": 2,
            "head_dim": 16,
            "vocab_size": 320,
        },
        "vision": {
            "hidden_size": 32,
            "intermediate_size": 48,
            "num_hidden_layers": 2,
            "num_attention_heads": 2,
            "patch_size": 8,
        },
        "model": {"scale_factor": 2},
    },
}
"""Sizes of SmolVLA's language model and vision tower, as transformers names them."""
LAYERS: dict[Size, Layers] = {
    "base": Layers(((2048, 16384), (16384, 2048), (2048, 2048), (1152, 4304)), 26112, 128),
    "tiny": Layers(((64, 128),), 32, 4),
}
STACK: dict[Size, Stack] = {"base": Stack(12, 2048, 8192, 128), "tiny": Stack(2, 64, 32, 4)}


def policy_batch(policy: Policy, size: int) -> dict[str, Any]:
    """Draw a batch of `size` samples; the same numbers on every machine.

    Returns:
        images: one `[B, H, W, 3]` f32 in [-1, 1] per camera.
        tokens: `[B, T]` int32, all valid.
        state: `[B, A]` f32, and actions: `[B, C, A]` f32, standard normal.
    """
    rng = np.random.default_rng(0)
    shape = (size, policy.image, policy.image, 3)
    return {
        "images": [
            2 * rng.random(shape, dtype=np.float32) - np.float32(1) for _ in range(policy.cameras)
        ],
        "tokens": rng.integers(1, 256, (size, policy.tokens), dtype=np.int32),
        "state": rng.standard_normal((size, policy.dim), dtype=np.float32),
        "actions": rng.standard_normal((size, policy.chunk, policy.dim), dtype=np.float32),
    }


def layer_arrays(shape: tuple[int, int], tokens: int) -> tuple[np.ndarray, ...]:
    """Draw x `[T, I]`, the kernel `[I, O]` and the gradient of the output `[T, O]`, all f32."""
    rng = np.random.default_rng(0)
    x, kernel, gradient = (
        rng.standard_normal(s, dtype=np.float32)
        for s in ((tokens, shape[0]), shape, (tokens, shape[1]))
    )
    return x, kernel / np.float32(shape[0] ** 0.5), gradient
