"""Where things are in a model: paths, and the rules that match them."""

import difflib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from flax import nnx

from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.dense import AdaptedLayer
from lorasp_jax.peft import Method
from lorasp_jax.peft._fields import short

Rules = Sequence[tuple[str, Method | None]]


class Location(NamedTuple):
    """Where a layer or parameter hangs in a model: `getattr(parent, name)` is `child`."""

    path: str
    parent: Any
    name: str
    child: Any


def locate(root: nnx.List[Any], kind: type | tuple[type, ...]) -> list[Location]:
    """All children of a type, with paths that start below the holder."""

    def walk() -> Iterator[Location]:
        for path, module in nnx.iter_modules(root):
            for name, child in vars(module).items():
                if isinstance(child, kind):
                    yield Location("/".join(map(str, (*path, name)[1:])), module, name, child)

    return list(walk())


def unique(found: list[Location]) -> list[Location]:
    """Without the further places of a child that hangs in several."""
    return list({id(location.child): location for location in reversed(found)}.values())[::-1]


def set_child(location: Location, child: Any) -> None:
    """Hangs another child into a place: the parent is anyone's, so its attribute has any name."""
    setattr(location.parent, location.name, child)


def replace(found: Sequence[Location], make: Callable[[Location], Any]) -> None:
    """Hangs something else into the places of children.

    Args:
      found: the places.
      make: what to put into a place, or None to try the child's next one. It is asked once for a
        child that hangs in several places, all of which get the same; but each place of an
        `nnx.Linear` gets its own, so that it has an adapter of its own there.
    """
    made: dict[Any, Any] = {}
    for location in found:
        if _one(location) not in made and (new := make(location)) is not None:
            made[_one(location)] = new
    for location in found:
        if _one(location) in made:
            set_child(location, made[_one(location)])


def _one(location: Location) -> Any:
    """What is the same for places that get the same."""
    return location.path if isinstance(location.child, nnx.Linear) else id(location.child)


def locate_layers(
    root: nnx.List[Any], einsums: nnx_layers.Einsums = MappingProxyType({})
) -> list[Location]:
    """All layers that have an adapter or could."""
    return [
        location
        for location in locate(root, nnx.Module)
        if isinstance(location.child, AdaptedLayer) or nnx_layers.kind(location.child, einsums)
    ]


def locate_matmul_layers(
    root: nnx.List[Any], einsums: nnx_layers.Einsums = MappingProxyType({})
) -> list[Location]:
    """The layers that multiply their input by matrices: dense ones and einsums, adapted or not."""
    found = locate_layers(root, einsums)
    return [location for location in found if not isinstance(location.child, nnx.Embed | nnx.Conv)]


def check_rules(rules: Any, valid: Callable[[Any], bool], what: str) -> None:
    """Raises a ValueError unless these are rules of regular expressions.

    Args:
      rules: what somebody gave.
      valid: whether something can be in the second place.
      what: such things in words.
    """
    pairs = f"rules are a list of (pattern, {what}) pairs"
    if isinstance(rules, Mapping):
        raise ValueError(f"{pairs}, got a {type(rules).__name__}: give list(rules.items()).")
    if not isinstance(rules, Sequence) or isinstance(rules, str) or not rules:
        shown = "none" if isinstance(rules, list | tuple) else short(rules)
        raise ValueError(f"{pairs}, at least one, got {shown}.")
    if isinstance(rules[0], str):
        raise ValueError(f"{pairs}, got {short(rules)}: one rule alone is [(pattern, ...)].")
    for rule in rules:
        if not isinstance(rule, tuple | list) or len(rule) != 2 or not isinstance(rule[0], str):
            raise ValueError(f"{pairs}, got {short(rule)} among them.")
        pattern, value = rule
        if isinstance(value, type):
            name = value.__name__
            raise ValueError(f"rule {short(pattern)} has the class {name}: write {name}().")
        if not valid(value):
            raise ValueError(f"rule {short(pattern)} has {short(value)} where {what} belongs.")
        try:
            re.compile(pattern)
        except (re.error, OverflowError, RecursionError) as error:
            raise ValueError(
                f"rule {short(pattern)} is no regular expression: {short(str(error))[1:-1]}."
            ) from error


def check_method_rules(rules: Any) -> None:
    """`check_rules` for rules that attach methods."""
    check_rules(rules, lambda m: m is None or isinstance(m, Method), "method or None")


def find_rule(rules: Rules, *paths: str) -> int | None:
    """Index of the first rule that matches one of the paths."""
    hits = (i for i, (pattern, _) in enumerate(rules) if any(re.search(pattern, p) for p in paths))
    return next(hits, None)


def locate_other_matrices(
    root: nnx.List[Any], einsums: nnx_layers.Einsums = MappingProxyType({})
) -> list[Location]:
    """Parameters of two axes or more of modules that no adapter applies to; norms' are no matrices,
    though a stack gives them an axis."""
    known = {id(location.child) for location in locate_layers(root, einsums)}
    return [
        location
        for location in locate(root, nnx.Param)
        if id(location.parent) not in known
        and len(getattr(location.child.get_value(), "shape", ())) > 1
        if not isinstance(location.parent, AdaptedLayer) and location.name not in ("scale", "bias")
    ]


def no_match_message(pattern: str, known: Sequence[str], others: Mapping[str, str]) -> str:
    """What to say of a rule that applies to nothing.

    Args:
      pattern: of the rule.
      known: paths of the layers that adapters apply to.
      others: class by path of other modules that hold matrices.
    """
    close = near_misses(pattern, known) or "none"
    text = f"rule {short(pattern)} applies to nothing; layers here: {close}"
    if not others:
        return f"{text}."
    close = difflib.get_close_matches(pattern, others, n=3, cutoff=0.3) or list(others)[:3]
    listed = ", ".join(f"{path or 'the model'} ({others[path]})" for path in close)
    return f"{text}; of other classes: {listed}. {EINSUMS_HINT}."


EINSUMS_HINT = (
    "Where such a class is an einsum of input and parameter, einsums={Class: lambda layer: (name, "
    "equation)} takes it; FullFineTuning takes all"
)


def near_misses(wanted: str, known: Sequence[str]) -> str:
    """A few of the known names, those that are most like the wanted one, or the first."""
    return ", ".join(difflib.get_close_matches(wanted, known, n=5, cutoff=0.3) or known[:5])
