"""Reproduce the parameter columns of Tables I and II of the paper (arXiv 2603.07404).

The paper does not say how it counts. These rules reproduce its percentages to the last digit:

- Every linear layer of the PyTorch models has an adapter (422 in pi0, 303 in SmolVLA), including
  the unused lm_heads. The patch embedding is a convolution there and has no adapter.
- Totals without adapters are 3,501,372,176 for pi0 and 450,046,176 for SmolVLA. pi0's includes the
  action expert's lm_head, which openpi's checkpoints do not contain. "Trainable/Total" is
  adapters / (total + adapters).
- LoRA-MoE has 4 experts of rank 32. AdaLoRA starts at rank 128 and has a diagonal that LoRA lacks.
- LoRA-SP is `LoRASP.paper()`, with a router of width 4, the only constant width that fits both
  backbones. It omits the five linear layers outside the towers; with them, SmolVLA would have 17.2
  instead of 17.1. The released code has a router as wide as the bank, which gives 12.0 and 23.0
  instead of 9.2 and 17.1.
"""

import functools
import math

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.adapters.adaptation import Counts
from lorasp_jax.adapters.paths import locate
from lorasp_jax.dense import Dense
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig
from lorasp_jax.peft import AdaLoRA, FullFineTuning, LoRA, LoRAMoE, LoRASP, Method

Shapes = dict[str, tuple[int, ...]]
"""Path -> [I, O], or [L, I, O] for stacked layers."""

STRATEGIES: dict[str, dict[str, Method]] = {
    "I": {
        "LoRA (r=128)": LoRA(rank=128),
        "LoRA-MoE (top-1)": LoRAMoE(routing="top1"),
        "LoRA-MoE (weighted sum)": LoRAMoE(),
        "AdaLoRA": AdaLoRA(rank=128),
        "Full FT": FullFineTuning(),
        "LoRA-SP": LoRASP.paper(),
    },
    "II": {
        **{f"LoRA (r={rank})": LoRA(rank=rank) for rank in (8, 16, 32, 64, 128)},
        "Full FT": FullFineTuning(),
        "LoRA-SP": LoRASP.paper(),
    },
}
"""Table -> rows, the same for both backbones."""

BACKBONES: dict[str, BackboneConfig] = {"π0": Pi0Config.base(), "SmolVLA": SmolVLAConfig.base()}


def count(config: BackboneConfig, method: Method) -> Counts:
    """Count trainable and total parameters as the paper does, from shapes alone."""
    shapes, total = linear_layers(config)
    if method.trains_base:
        return Counts(total, total)
    if isinstance(method, LoRASP):
        shapes = {path: shape for path, shape in shapes.items() if "/" in path}
    adapters = sum(
        math.prod(stack) * _size(method, d_in, d_out) for *stack, d_in, d_out in shapes.values()
    )
    return Counts(adapters, total + adapters)


def parameter_column(table: str) -> dict[tuple[str, str], str]:
    """Return "Trainable/Total (%)" of table "I" or "II" as printed, by (backbone, strategy)."""
    column = {}
    for backbone, config in BACKBONES.items():
        for strategy, method in STRATEGIES[table].items():
            trainable, total = count(config, method)
            column[backbone, strategy] = f"{100 * trainable / total:.1f}"
    return column


@functools.cache
def linear_layers(config: BackboneConfig) -> tuple[Shapes, int]:
    """Return the layers that the paper adapts, and the parameter count without adapters."""
    model = nnx.eval_shape(lambda: config.create(nnx.Rngs(0)))
    total = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(nnx.state(model, nnx.Param)))
    shapes = {
        location.path: location.child.kernel.get_value().shape
        for location in locate(nnx.List([model]), Dense)
        if location.path != "vision/patch_embed"
    }
    shapes["language/lm_head"] = (config.language.width, config.vocabulary)
    if isinstance(config, Pi0Config):  # the action expert's lm_head is not tied
        shapes["action/lm_head"] = (config.action.width, config.vocabulary)
        total += config.action.width * config.vocabulary
    return shapes, total


@functools.cache
def _size(method: Method, d_in: int, d_out: int) -> int:
    kernel = jax.ShapeDtypeStruct((d_in, d_out), jnp.float32)
    params = jax.eval_shape(lambda key: method.init(key, kernel)[0], jax.random.key(0))
    return sum(leaf.size for leaf in jax.tree.leaves(params))
