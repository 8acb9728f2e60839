"""Match untrusted regular expressions against module names, rejecting catastrophic backtracking.

Python's `re` may try every way in which a pattern could match: about 2**30 for the pattern (a+)+b
and a name of thirty a's. `_ways` computes an upper bound from the parsed pattern.
"""

import importlib
import re
from collections.abc import Collection, Iterable, Mapping
from typing import Any

# The parser that re uses; before Python 3.11 it was public, as sre_parse.
_parse = importlib.import_module("re._parser").parse
_ONE_WAY = {"LITERAL", "NOT_LITERAL", "ANY", "IN", "AT"}
MAX_WAYS = 3 * 10**8
"""Limit for all patterns and names together: about ten seconds of matching."""


def values_of(patterns: Mapping[str, Any], names: Collection[str], default: Any) -> dict[str, Any]:
    """Map each name to the value of the first pattern that matches it or a suffix after a dot.

    As in Hugging Face PEFT (get_pattern_key of 0.21.2): re.match(rf"(.*\\.)?({pattern})$", name).

    Args:
        patterns: values by pattern.
        names: module names, as in "a.0.b".
        default: value of a name without a match.

    Raises:
        ValueError: a pattern is invalid or not supported, or matching could take too long.
    """
    anchored = {rf"(.*\.)?({pattern})$": value for pattern, value in patterns.items()}
    longest, ways = max(map(len, names), default=0), 0
    for pattern, pattern_text in zip(anchored, patterns, strict=True):
        try:
            ways += len(names) * _ways(_parse(pattern), longest)
        except re.error as error:
            raise ValueError(f"{pattern_text!r} is not a regular expression: {error}") from error
        if ways > MAX_WAYS:
            raise ValueError(f"{pattern_text!r} could take too long to match {len(names)} names")
    compiled = [(re.compile(pattern), value) for pattern, value in anchored.items()]
    values = {}
    for name in names:
        hits = (value for pattern, value in compiled if pattern.match(name))
        values[name] = next(hits, default)
    return values


def _ways(tree: Iterable[tuple[Any, Any]], length: int) -> int:
    """Upper bound on the number of ways to match `length` characters, capped at `MAX_WAYS` + 1.

    Raises:
        ValueError: the pattern has a construct that PEFT's patterns do not need.
    """
    ways = 1
    for kind, argument in tree:
        match str(kind):
            case "SUBPATTERN":
                ways *= _ways(argument[-1], length)
            case "BRANCH":
                ways *= sum(_ways(branch, length) for branch in argument[-1])
            case "MAX_REPEAT" | "MIN_REPEAT":
                minimum, maximum, repeated = argument
                ways_once, maximum = _ways(repeated, length), min(maximum, length)
                ways *= sum(ways_once**times for times in range(minimum, maximum + 1)) or 1
            case name if name not in _ONE_WAY:
                raise ValueError(f"a pattern with {name} is not supported")
        ways = min(ways, MAX_WAYS + 1)
    return ways
