"""The rules by which a run adapts its model: which layers get which method."""

import math
import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import jax
from flax import nnx

from lorasp_jax.adapters import paths
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.config import Config
from lorasp_jax.dense import AdaptedLayer, AdapterParam
from lorasp_jax.models import presets
from lorasp_jax.models.noise_actor import PATH
from lorasp_jax.peft import Method
from lorasp_jax.peft.plan import Shapes

TOWERS = ("vision", "language", "action")


def named_rules(config: Config) -> presets.NamedRules:
    """Return a run's rules by their text: those of `adapt` or `plan`, or `peft` on all `targets`.

    Raises:
        ValueError: a rule or target is invalid, or only full fine-tuning trains a quantized base.
    """
    found: presets.NamedRules
    if config.adapt:
        found = presets.parse(config.adapt, config.peft)
    elif config.plan:
        found = config.plan.rules(config.peft)
    else:
        found = {p: (p, config.peft) for p in presets.patterns(config.targets)}
    if config.model.base_dtype and all(not m or m.trains_base for _, m in found.values()):
        raise ValueError("model.base_dtype must be empty for full, which trains the base")
    return found


def rules(config: Config, *, as_saved: bool = False) -> paths.Rules:
    """Return a run's rules for `adapt`; with `as_saved`, they need no statistics."""
    found = named_rules(config).values()
    return [(pattern, m.as_saved if m and as_saved else m) for pattern, m in found]


def methods(config: Config) -> list[Method]:
    """Return the distinct methods of a run's rules."""
    return [*dict.fromkeys(method for _, method in rules(config) if method)]


def check_plan(config: Config, model: nnx.Module) -> None:
    """Raise ValueError if a run has a plan that is not one for the layers of its targets.

    Args:
        config: the run's config.
        model: the base, or its shapes.
    """
    if config.plan:
        config.plan.check(shapes(model, presets.patterns(config.targets)))


def shapes(model: nnx.Module, patterns: Sequence[str] = ("",)) -> Shapes:
    """Return the shapes of a model's layers whose path one of the patterns matches."""
    found: dict[str, tuple[int, int, int]] = {}
    for layer in paths.locate_layers(nnx.List([model])):
        if any(re.search(pattern, layer.path) for pattern in patterns):
            *stack, d_in, d_out = nnx_layers.matrices_shape(layer.child, {})
            found[layer.path] = math.prod(stack), d_in, d_out
    return found


def trains_base(config: Config) -> bool:
    """Return whether a run trains base weights and nothing else, so that it exports a base."""
    return all(method.trains_base for method in methods(config))


def describe(config: Config) -> str:
    """Name a run's rules, or its only method, on one line."""
    return " ".join(config.adapt) or type(config.peft).__name__


def by_rule(
    config: Config, model: nnx.Module, metrics: Mapping[str, float] = MappingProxyType({})
) -> dict[str, dict[str, Any]]:
    """Return what each rule of a run trains, by its text.

    Args:
        config: the run's config.
        model: the adapted model, or its shapes.
        metrics: logged scalars, for the active rank.

    Returns:
        `layers`, counting every layer of a stack; `parameters`, the trainable ones, including those
        outside of layers; and `active_rank`, averaged over layers, if `metrics` has it.
    """
    names, pairs = [*named_rules(config)], rules(config)
    found: dict[str, dict[str, Any]] = {name: {"layers": 0, "parameters": 0} for name in names}
    ranks: dict[str, list[float]] = {}
    for path, parent, name, variable in paths.locate(nnx.List([model]), AdapterParam):
        layer = path.rpartition("/")[0]
        i = paths.find_rule(pairs, layer, *([] if name == "adapter" else [path]))
        if i is None:
            assert path == PATH  # other paths have passed the same rules in `adapt`
            continue
        row = found[names[i]]
        row["parameters"] += sum(leaf.size for leaf in jax.tree.leaves(variable.get_value()))
        if isinstance(parent, AdaptedLayer) and name in ("adapter", parent.kernel_name):
            stacked = math.prod(parent.stack_shape())
            row["layers"] += stacked
            rank = metrics.get(f"active_rank/{tower(layer)}/{short_name(layer)}")
            ranks.setdefault(names[i], []).extend([] if rank is None else stacked * [rank])
    for name, values in ranks.items():
        if values:
            found[name]["active_rank"] = sum(values) / len(values)
    return found


def tower(path: str) -> str:
    """Return the tower of a parameter path; layers outside the towers belong to "action"."""
    first = path.partition("/")[0]
    return first if first in TOWERS else "action"


def short_name(path: str) -> str:
    """Return a layer's path in its tower, as active ranks name it, such as "q_proj"."""
    return path.removeprefix(f"{tower(path)}/").removeprefix("blocks/")
