"""Regular expressions of a stranger over the names of modules, refused if they may take for ever.

Python tries one way after another in which a pattern may match: (a+)+b has 2**30 of them on thirty
times "a". How many there can be follows from the pattern.
"""

import importlib
import re
from collections.abc import Collection, Iterable, Mapping
from typing import Any

# What re itself parses a pattern with; public until Python 3.11, as sre_parse.
_parse = importlib.import_module("re._parser").parse
_ONE_WAY = {"LITERAL", "NOT_LITERAL", "ANY", "IN", "AT"}
MOST_WAYS = 3 * 10**8
"""For all patterns on all names: some ten seconds."""


def values_of(patterns: Mapping[str, Any], names: Collection[str], default: Any) -> dict[str, Any]:
    """By name, the value of the first pattern that is all of it, or all that follows a dot in it.

    As Hugging Face PEFT does (get_pattern_key of 0.21.2): re.match(rf"(.*\\.)?({pattern})$", name).

    Args:
      patterns: value by pattern.
      names: of modules, "a.0.b".
      default: value of a name that none matches.

    Raises:
      ValueError: what is no such pattern, or what could take too long.
    """
    whole = {rf"(.*\.)?({pattern})$": value for pattern, value in patterns.items()}
    longest, ways = max(map(len, names), default=0), 0
    for pattern, given in zip(whole, patterns, strict=True):
        try:
            ways += len(names) * _ways(_parse(pattern), longest)
        except re.error as error:
            raise ValueError(f"{given!r} is not a valid regular expression: {error}") from error
        if ways > MOST_WAYS:
            raise ValueError(f"the pattern {given!r} could take too long for {len(names)} names.")
    compiled = [(re.compile(pattern), value) for pattern, value in whole.items()]
    found = {}
    for name in names:
        hits = (value for pattern, value in compiled if pattern.match(name))
        found[name] = next(hits, default)
    return found


def _ways(tree: Iterable[tuple[Any, Any]], length: int) -> int:
    """In how many ways at most a parsed pattern can match so many letters, up to `MOST_WAYS` + 1.

    Raises:
      ValueError: what PEFT's patterns have no use for.
    """
    ways = 1
    for kind, argument in tree:
        match str(kind):
            case "SUBPATTERN":
                ways *= _ways(argument[-1], length)
            case "BRANCH":
                ways *= sum(_ways(branch, length) for branch in argument[-1])
            case "MAX_REPEAT" | "MIN_REPEAT":
                fewest, most, repeated = argument
                once, most = _ways(repeated, length), min(most, length)
                ways *= sum(once**times for times in range(fewest, most + 1)) or 1
            case name if name not in _ONE_WAY:
                raise ValueError(f"a pattern with {name} is not supported.")
        ways = min(ways, MOST_WAYS + 1)
    return ways
