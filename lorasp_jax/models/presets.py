"""Presets: named sets of layers to adapt, for every backbone.

    model = adapt(model, presets.rules("expert-only", LoRASP(rank=64)), rngs=rngs)
    model = adapt(model, presets.rules(["vision", "language/.*q_proj"], LoRA()), rngs=rngs)

A preset is a list of regular expressions over layer paths, as in `lorasp_jax.adapt`. With
`FullFineTuning`, the expressions also match norms and embeddings. Anything that no rule matches
stays frozen.
"""

import difflib
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
_WORD = re.compile(r"[A-Za-z_ -]+")


def patterns(targets: str | Sequence[str]) -> list[str]:
    """Replace the preset names in a list of targets with their regular expressions.

    Args:
        targets: preset names and regular expressions over layer paths, in any combination.

    Raises:
        ValueError: a misspelled or unknown preset name.
    """
    targets = [targets] if isinstance(targets, str) else targets
    for target in targets:
        suggestion = _suggestion(target)
        if target not in PRESETS and (suggestion or _PRESET_NAME.fullmatch(target)):
            hint = f" (did you mean {suggestion!r}?)" if suggestion else ""
            raise ValueError(f"unknown preset {target!r}{hint}: choose one of {', '.join(PRESETS)}")
    return [pattern for target in targets for pattern in PRESETS.get(target, (target,))]


def _suggestion(target: str) -> str | None:
    """Find the preset that a target misspells; None for substrings of preset names or patterns."""
    texts = (text for name, patterns in PRESETS.items() for text in (name, *patterns))
    if not _WORD.fullmatch(target) or any(target in text for text in texts):
        return None
    matches = difflib.get_close_matches(target.lower(), PRESETS, n=1, cutoff=0.8)
    return matches[0] if matches else None


def rules(targets: str | Sequence[str], method: Method | None) -> Rules:
    """Build rules for `adapt` that attach one method to all targets; see `patterns`."""
    return [(pattern, method) for pattern in patterns(targets)]
