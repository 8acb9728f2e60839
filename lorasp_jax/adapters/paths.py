"""Locate modules and parameters in a model by path, and match path rules against them."""

import contextlib
import difflib
import re
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
from flax import nnx

from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.dense import AdaptedLayer
from lorasp_jax.peft import Method
from lorasp_jax.peft.fields import short

Rules = Sequence[tuple[str, Method | None]]


class Location(NamedTuple):
    """Path and parent of a module or parameter: `getattr(parent, name)` is `child`."""

    path: str
    parent: Any
    name: str
    child: Any


def locate(root: nnx.List[Any], kind: type | tuple[type, ...]) -> list[Location]:
    """List all modules or variables of the given types.

    `root` is `nnx.List([model])`; paths are relative to the model.
    """
    return [
        Location("/".join(map(str, (*path, name)[1:])), module, name, child)
        for path, module in nnx.iter_modules(root)
        for name, child in vars(module).items()
        if isinstance(child, kind)
    ]


def by_path(tree: Any) -> dict[str, Any]:
    """Return the leaves of a dict or an `nnx.State` by "/"-joined path, in tree order."""
    leaves = jax.tree_util.tree_leaves_with_path(
        nnx.to_pure_dict(tree) if isinstance(tree, nnx.State) else tree
    )
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


@contextlib.contextmanager
def naming(doing: str, where: object) -> Iterator[None]:
    """Say in a ValueError what was done and where, such as "adapt" and a layer's path."""
    try:
        yield
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"cannot {doing} {where or 'the model'}: {error}") from error


def set_child(location: Location, child: Any) -> None:
    """Replace the child at a location."""
    setattr(location.parent, location.name, child)


def replace(locations: Sequence[Location], make: Callable[[Location], Any]) -> None:
    """Replace children in place.

    `make` returns the replacement for a location, or None to skip it. A shared child gets one
    replacement for all its locations, the first that is not None. Only a shared `nnx.Linear` is
    replaced separately at each location, so that each location has its own adapter.
    """
    replacements: dict[Hashable, Any] = {}
    for location in locations:
        if _identity(location) not in replacements and (new := make(location)) is not None:
            replacements[_identity(location)] = new
    for location in locations:
        if _identity(location) in replacements:
            set_child(location, replacements[_identity(location)])


def _identity(location: Location) -> Hashable:
    """Key that is equal for locations that get the same replacement."""
    return location.path if isinstance(location.child, nnx.Linear) else id(location.child)


def locate_layers(
    root: nnx.List[Any], einsums: nnx_layers.Einsums = MappingProxyType({})
) -> list[Location]:
    """List all layers that have or can have an adapter."""
    return [
        location
        for location in locate(root, nnx.Module)
        if isinstance(location.child, AdaptedLayer)
        or nnx_layers.supported_class(location.child, einsums)
    ]


def locate_matmul_layers(root: nnx.List[Any]) -> list[Location]:
    """List dense layers and einsums, adapted or not; embeddings and convolutions are skipped."""
    skipped = nnx.Embed | nnx.Conv
    return [layer for layer in locate_layers(root) if not isinstance(layer.child, skipped)]


def check_rules(rules: Any, valid: Callable[[Any], bool], what: str) -> None:
    """Raise ValueError unless `rules` is a non-empty list of (pattern, value) pairs.

    `valid` checks one value; `what` describes valid values in the error message.
    """
    expected = f"rules must be a non-empty list of (pattern, {what}) pairs"
    if not isinstance(rules, list | tuple) or not rules:
        raise ValueError(f"{expected}, got {short(rules)}")
    for rule in rules:
        is_pair = isinstance(rule, tuple | list) and len(rule) == 2 and isinstance(rule[0], str)
        if not is_pair or not valid(rule[1]):
            raise ValueError(f"{expected}, got {short(rule)}")
        try:
            re.compile(rule[0])
        except re.error as error:
            raise ValueError(f"{short(rule[0])} is not a regular expression: {error}") from error


def check_method_rules(rules: Any) -> None:
    """Raise ValueError unless `rules` is a list of (pattern, method or None) pairs."""
    check_rules(rules, lambda m: m is None or isinstance(m, Method), "method or None")


def find_rule(rules: Rules, *paths: str) -> int | None:
    """Index of the first rule that matches at least one of the paths, or None."""
    hits = (i for i, (pattern, _) in enumerate(rules) if any(re.search(pattern, p) for p in paths))
    return next(hits, None)


def locate_other_matrices(
    root: nnx.List[Any], einsums: nnx_layers.Einsums = MappingProxyType({})
) -> list[Location]:
    """List parameters with two or more axes in modules that adapters do not support.

    Scales and biases are skipped, since those of stacked norms have two axes.
    """
    supported = {id(location.child) for location in locate_layers(root, einsums)}
    return [
        location
        for location in locate(root, nnx.Param)
        if id(location.parent) not in supported
        and len(getattr(location.child.get_value(), "shape", ())) > 1
        if not isinstance(location.parent, AdaptedLayer) and location.name not in ("scale", "bias")
    ]


def unsupported_classes(
    root: nnx.List[Any], einsums: nnx_layers.Einsums = MappingProxyType({})
) -> dict[str, str]:
    """Class names of the modules with matrices that adapters do not support, by path."""
    others = locate_other_matrices(root, einsums)
    return {other.path.rpartition("/")[0]: type(other.parent).__name__ for other in others}


def no_match_message(pattern: str, layers: Sequence[str], others: Mapping[str, str]) -> str:
    """Error message for a rule that applies to nothing; arguments as in `available_layers`."""
    return f"rule {short(pattern)} applies to nothing; {available_layers(pattern, layers, others)}"


def available_layers(query: str, layers: Sequence[str], others: Mapping[str, str]) -> str:
    """List what resembles a name, for an error message.

    `layers` are the names of supported layers. `others` maps the paths of other modules with
    matrices to their class names.
    """
    text = f"available layers: {near_misses(query, layers) or 'none'}"
    if not others:
        return f"{text}."
    close = difflib.get_close_matches(query, others, n=3, cutoff=0.3) or list(others)[:3]
    listed = ", ".join(f"{path or 'the model'} ({others[path]})" for path in close)
    return f"{text}; unsupported classes: {listed}. {EINSUMS_HINT}."


EINSUMS_HINT = (
    "If such a class computes an einsum of its input and a parameter, pass einsums={Class: "
    "lambda layer: (name, equation)}; FullFineTuning supports every class"
)


def near_misses(query: str, names: Sequence[str]) -> str:
    """Join up to five names that resemble the query, or the first five if none does."""
    return ", ".join(difflib.get_close_matches(query, names, n=5, cutoff=0.3) or names[:5])
