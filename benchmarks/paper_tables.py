"""The parameter columns of Tables I and II of the paper (arXiv 2603.07404), counted as it did.

Found from its percentages, to the last printed digit; the paper itself does not say it:

- adapters sit on every linear layer of the PyTorch models (422 in pi0, 303 in SmolVLA), lm_heads
  included, which no computation reads; the patch embedding is a convolution there;
- the total has pi0's expert lm_head too, which no published file of openpi's holds: 3,501,372,176
  and 450,046,176; "Trainable/Total" is adapters / (total + adapters);
- LoRA-MoE is 4 experts of rank 32; AdaLoRA has rank 128 at the start, a diagonal more than LoRA;
- LoRA-SP is `LoRASP.paper()`, a router 4 wide, and leaves out the five linear maps around the
  towers. Of constant widths 4 alone fits both backbones, and with those five 17.1 would be 17.2.
  Its released code, a router as wide as the bank, gives 12.0 and 23.0 instead of 9.2 and 17.1.

Every number of the two columns is given. Active ranks and success were measured, not counted, and
pi0's LoRA-SP row of success differs between the two tables (80 and 60 % for opening the pot).
"""

import math

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.adapters.adaptation import Counts
from lorasp_jax.adapters.paths import places
from lorasp_jax.dense import Dense
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig
from lorasp_jax.peft import AdaLoRA, FullFineTuning, LoRA, LoRAMoE, LoRASP, Method

Shapes = dict[str, tuple[int, ...]]
"""[I, O], or [L, I, O] of a stack, by path."""

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
"""The rows of each table, for either backbone."""

BACKBONES: dict[str, BackboneConfig] = {"π0": Pi0Config.base(), "SmolVLA": SmolVLAConfig.base()}


def count(config: BackboneConfig, method: Method) -> Counts:
    """What trains and all parameters, as the paper counts; from shapes, nothing is allocated.

    Args:
        config: a backbone's sizes.
        method: an adapter method, or full fine-tuning.
    """
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
    """The column "Trainable/Total (%)" of table "I" or "II" as printed, by (backbone, strategy)."""
    found = {}
    for backbone, config in BACKBONES.items():
        for strategy, method in STRATEGIES[table].items():
            trainable, total = count(config, method)
            found[backbone, strategy] = f"{100 * trainable / total:.1f}"
    return found


def linear_layers(config: BackboneConfig) -> tuple[Shapes, int]:
    """What the paper adapts, by path, and the model's number of parameters without adapters."""
    model = nnx.eval_shape(lambda: config.create(nnx.Rngs(0)))
    total = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(nnx.state(model, nnx.Param)))
    shapes = {
        place.path: place.child.kernel.get_value().shape
        for place in places(nnx.List([model]), Dense)
        if place.path != "vision/patch_embed"
    }
    shapes["language/lm_head"] = (config.language.width, config.vocabulary)
    if isinstance(config, Pi0Config):  # tied to the embedding; the expert has its own
        shapes["action/lm_head"] = (config.action.width, config.vocabulary)
        total += config.action.width * config.vocabulary
    return shapes, total


def _size(method: Method, d_in: int, d_out: int) -> int:
    """Parameters of one adapter."""
    kernel = jax.ShapeDtypeStruct((d_in, d_out), jnp.float32)
    params = jax.eval_shape(lambda key: method.init(key, kernel)[0], jax.random.key(0))
    return sum(leaf.size for leaf in jax.tree.leaves(params))
