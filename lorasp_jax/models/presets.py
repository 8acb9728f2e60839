"""Presets: named sets of layers to adapt, for every backbone.

    model = adapt(model, presets.rules("expert-only", LoRASP(rank=64)), rngs=rngs)
    model = adapt(model, presets.rules(["vision", "language/.*q_proj"], LoRA()), rngs=rngs)

A preset is a list of regular expressions over layer paths, as in `lorasp_jax.adapt`. With
`FullFineTuning`, the expressions also match norms and embeddings. Anything that no rule matches
stays frozen.
"""

import re
from collections.abc import Sequence

from lorasp_jax.adapters.paths import Rules
from lorasp_jax.peft import Method

_PROJECTIONS = r"^(state_proj|action_in_proj|action_out_proj|(action_)?time_mlp_(in|out))"
"""Projections outside the towers."""

PRESETS: dict[str, tuple[str, ...]] = {
    # As in Table I of arXiv 2603.07404, except layers that do not affect the actions. The paper's
    # code adapts every `nn.Linear`; the patch embedding is a convolution there.
    "paper": ("^(?!vision/patch_embed)",),
    # The patch embedding is a linear layer here.
    "all-linear": (".*",),
    # The layers that openpi's "gemma_2b_lora" and "gemma_300m_lora" adapt (models/gemma.py).
    "openpi": (r"^(language|action)/blocks/(.*/)?[a-z]+_proj$",),
    # The layers that LeRobot trains if `train_expert_only` is set.
    "expert-only": ("^action/", _PROJECTIONS),
    "vision": ("^vision/",),
    "language": ("^language/",),
    "action": ("^action/",),
}
"""Preset name -> regular expressions over layer paths."""

_PRESET_NAME = re.compile(r"[a-z]+(-[a-z]+)+")  # layer paths contain no hyphens


def patterns(targets: str | Sequence[str]) -> list[str]:
    """Replace the preset names in a list of targets with their regular expressions.

    Args:
        targets: preset names and regular expressions over layer paths, in any combination.

    Raises:
        ValueError: an unknown preset name with a hyphen, which no path contains.
    """
    targets = [targets] if isinstance(targets, str) else targets
    for target in targets:
        if target not in PRESETS and _PRESET_NAME.fullmatch(target):
            raise ValueError(f"unknown preset {target!r}: choose one of {', '.join(PRESETS)}")
    return [pattern for target in targets for pattern in PRESETS.get(target, (target,))]


def rules(targets: str | Sequence[str], method: Method | None) -> Rules:
    """Build rules for `adapt` that attach one method to all targets; see `patterns`."""
    return [(pattern, method) for pattern in patterns(targets)]
