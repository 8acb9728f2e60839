"""Names and shapes of SmolVLA's parameters as LeRobot publishes them (policies/smolvla)."""

import re

from lorasp_jax.models.checkpoints.layouts import Rule, copied, transposed
from lorasp_jax.models.checkpoints.torch_layouts import PROJECTIONS, decoder, linear, siglip
from lorasp_jax.models.smolvla.smolvla import SmolVLAConfig

UNUSED: tuple[str, ...] = ()
"""Empty: the model keeps SmolLM2's head, because LeRobot saves it."""
TIED: dict[str, str] = {}

_VLM = "vlm_with_expert.vlm"
_TEXT = f"{_VLM}.model.text_model"
_EXPERT = "vlm_with_expert.lm_expert"
_ROOT = re.compile(r"(?:^|\.)((?:vlm_with_expert|state_proj|action_\w+)\..*)")


def lerobot_name(name: str) -> str:
    """Strip the version-dependent prefix from a LeRobot tensor name (LeRobot 0.4.4 to 0.6.1)."""
    match = _ROOT.search(name)
    return match[1] if match else name


def lerobot_layout(config: SmolVLAConfig) -> list[Rule]:
    """Rules for LeRobot's tensors, named without the leading "model."."""
    connector = f"{_VLM}.model.connector.modality_projection.proj"
    depth = config.action.depth
    rules = [
        *siglip(f"{_VLM}.model.vision_model", config.vision),
        transposed("vision/head/kernel", f"{connector}.weight"),
        copied("language/embedding", f"{_TEXT}.embed_tokens.weight"),
        copied("language/lm_head", f"{_VLM}.lm_head.weight"),
        *decoder("language/blocks", _TEXT, range(config.language.depth)),
        *decoder("action/blocks/self_layer", _EXPERT, range(0, depth, 2)),
        *decoder("action/blocks/cross_layer", _EXPERT, range(1, depth, 2)),
        copied("language/norm/scale", f"{_TEXT}.norm.weight"),
        copied("action/norm/scale", f"{_EXPERT}.norm.weight"),
    ]
    for name in PROJECTIONS:
        rules += linear(name, name)
    return rules


LAYOUTS = {"lerobot": lerobot_layout}
"""Layout name -> function (config) -> rules."""
