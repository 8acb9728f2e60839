"""Presets: named sets of layers to adapt, and named recipes of rules, for every backbone.

    model = adapt(model, presets.rules("expert-only", LoRASP(rank=64)), rngs=rngs)
    model = adapt(model, presets.rules(["vision", "language/.*q_proj"], LoRA()), rngs=rngs)
    model = adapt(model, [*presets.parse(["language=lora:16", "action=full"]).values()], rngs=rngs)

A preset is a list of regular expressions over layer paths, as in `lorasp_jax.adapt`. With
`FullFineTuning`, the expressions also match norms and embeddings. Anything that no rule matches
stays frozen.
"""

import dataclasses
import re
from collections.abc import Iterable, Sequence

from lorasp_jax import peft
from lorasp_jax.adapters.paths import Rules
from lorasp_jax.peft import FullFineTuning, LoRA, LoRASP, Method

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
    "projections": (_PROJECTIONS,),
}
"""Preset name -> regular expressions over layer paths."""

_MOLMOACT = LoRA(rank=64, alpha=16.0, dropout=0.05)
_FULL = FullFineTuning()

RECIPES: dict[str, tuple[tuple[str, Method], ...]] = {
    "paper": (("paper", LoRASP(rank=128)),),
    # What openpi trains with "gemma_2b_lora" and "gemma_300m_lora": its freeze filter spares all
    # that is outside the language models (models/pi0_config.py, models/gemma.py). Its LoRA has a
    # pair of matrices per head, hence more parameters.
    "openpi-lora": (
        ("^language/.*_proj$", LoRA(rank=16, alpha=16.0)),
        ("^action/.*_proj$", LoRA(rank=32, alpha=32.0)),
        ("vision", _FULL),
        ("projections", _FULL),
    ),
    # Rank, alpha and dropout of MolmoAct2 in LeRobot (policies/molmoact2/configuration_molmoact2.py
    # at 7427f31), whose action expert trains in full and whose embeddings are frozen. There, A is
    # from N(0, 1/R^2), and all learning rates are 5e-5.
    "vlm-lora+expert-full": (
        ("vision", _MOLMOACT),
        ("language", _MOLMOACT),
        ("expert-only", _FULL),
    ),
    "expert-only": (("expert-only", _FULL),),
}
"""Recipe name -> (target, method) pairs; a target is a preset or a regular expression."""

NamedRules = dict[str, tuple[str, Method | None]]
"""Rules for `adapt` by their text, such as "language=lora:16"."""

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


def parse(texts: Iterable[str], method: Method | None = None) -> NamedRules:
    """Parse rules from a command line.

    Args:
        texts: names of `RECIPES`, and TARGET=METHOD[:RANK], where TARGET is a preset or a regular
            expression, and METHOD a name of `lorasp_jax.peft` or "none", which skips the layers.
        method: gives a rule of the same method its settings; others have their defaults.

    Raises:
        ValueError: a text is neither; an unknown preset with a hyphen; an unknown method; a rank
            that is invalid or that the method lacks; or no rule has a method.
    """
    found: NamedRules = {}
    for text in texts:
        target, equals, right = text.rpartition("=")
        if text in RECIPES:
            for target, chosen in RECIPES[text]:
                rank = getattr(chosen, "rank", None)
                label = f"{target}={chosen.name}" + (f":{rank}" if rank else "")
                found.setdefault(label, (_joined(target), chosen))
        elif target and equals:
            found.setdefault(text, (_joined(target), _method(text, right, method)))
        else:
            raise ValueError(
                f"{text!r} is no rule: write TARGET=METHOD[:RANK], such as language=lora:16, or "
                f"choose one of {', '.join(RECIPES)}"
            )
    if not any(chosen for _, chosen in found.values()):
        raise ValueError(f"no rule has a method: choose one of {', '.join(peft.names())}")
    return found


def _joined(target: str) -> str:
    """Join the regular expressions of a target, so that it remains one rule."""
    return "|".join(patterns(target))


def _method(text: str, right: str, current: Method | None) -> Method | None:
    """Return the method of the rule `text`, whose right side is METHOD[:RANK]."""
    name, colon, rank = right.partition(":")
    if name not in (valid := (*peft.names(), "none")):
        listed = ", ".join(valid)
        raise ValueError(f"unknown method {name!r} in rule {text!r}: choose one of {listed}")
    if current is None or current.name != name:
        current = None if name == "none" else peft.create(name)
    if not colon:
        return current
    if not hasattr(current, "rank"):
        raise ValueError(f"{name} has no rank: write {text.removesuffix(f':{rank}')!r}")
    if not rank.isdecimal():
        raise ValueError(f"the rank in rule {text!r} must be a whole number, got {rank!r}")
    try:
        return dataclasses.replace(current, rank=int(rank))  # type: ignore[call-arg]
    except ValueError as error:
        raise ValueError(f"rule {text!r}: {error}") from error
