"""Named choices of layers, for every backbone here: what a method is attached to.

    model = adapt(model, presets.rules("expert-only", LoRASP(rank=64)), rngs=rngs)
    model = adapt(model, presets.rules(["vision", "language/.*q_proj"], LoRA()), rngs=rngs)

A preset is some regular expressions over layer paths, as `lorasp_jax.adapt` takes them, so it also
says what `FullFineTuning` frees, norms and embeddings included. What no rule names stays frozen.
"""

import difflib
import re
from collections.abc import Sequence

from lorasp_jax.adapters.paths import Rules
from lorasp_jax.peft import Method

_AROUND = r"^(state_proj|action_in_proj|action_out_proj|(action_)?time_mlp_(in|out))"
"""The linear maps around the towers."""

PRESETS: dict[str, tuple[str, ...]] = {
    # Every linear layer of Table I of arXiv 2603.07404 that computes something: its code adapts
    # each `nn.Linear`, and there the patch embedding is a convolution.
    "paper": ("^(?!vision/patch_embed)",),
    # The patch embedding too, which is a linear map of a patch.
    "all-linear": (".*",),
    # What openpi's variants "gemma_2b_lora" and "gemma_300m_lora" adapt (its models/gemma.py).
    "openpi": (r"^(language|action)/blocks/(.*/)?[a-z]+_proj$",),
    # What LeRobot trains under `train_expert_only`.
    "expert-only": ("^action/", _AROUND),
    "vision": ("^vision/",),
    "language": ("^language/",),
    "action": ("^action/",),
}
"""Regular expressions over layer paths by the preset's name."""

_NAME = re.compile(r"[a-z]+(-[a-z]+)+")  # in no path there is a hyphen
_WORD = re.compile(r"[A-Za-z_ -]+")


def patterns(targets: str | Sequence[str]) -> list[str]:
    """The regular expressions that targets stand for.

    Args:
        targets: names of presets and regular expressions over layer paths, in any mixture.

    Raises:
        ValueError: a hyphenated word that names no preset, or a word that is nearly the name of one
            and no part of it.
    """
    targets = [targets] if isinstance(targets, str) else targets
    for target in targets:
        close = _meant(target)
        if target not in PRESETS and (close or _NAME.fullmatch(target)):
            hint = f" (did you mean {close!r}?)" if close else ""
            raise ValueError(
                f"there is no preset {target!r}{hint}: it is one of {', '.join(PRESETS)}."
            )
    return [pattern for target in targets for pattern in PRESETS.get(target, (target,))]


def _meant(target: str) -> str | None:
    """The preset whose name is misspelt here; a part of a name is a good regular expression."""
    parts = (part for name, patterns in PRESETS.items() for part in (name, *patterns))
    if not _WORD.fullmatch(target) or any(target in part for part in parts):
        return None
    known = difflib.get_close_matches(target.lower(), PRESETS, n=1, cutoff=0.8)
    return known[0] if known else None


def rules(targets: str | Sequence[str], method: Method | None) -> Rules:
    """The rules for `adapt` that attach one method to targets; see `patterns`."""
    return [(pattern, method) for pattern in patterns(targets)]
