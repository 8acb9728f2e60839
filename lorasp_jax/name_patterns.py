"""Regular expressions of a stranger over the names of modules, matched in bounded time.

Python's own may take for ever: (a+)+b does on thirty times "a". Here a pattern becomes states, all
of which advance by one letter at a time (Thompson, Communications of the ACM 11, 1968, 419-422),
so a name of n letters and a pattern of m take n m steps. Letters, ".", classes, "|", groups, "*",
"+", "?", "^" and "$" are understood.
"""

import functools
import re
from collections.abc import Callable, Collection, Mapping
from typing import Any, NoReturn, TypeAlias

_PLAIN = re.compile(r"\^?(?:[\w-]|\\?\.)*")
_TOKEN = re.compile(r"\\[dDsSwW]|\\[^\w\s]|\[\^?(?:\\.|[^\[\]\\])+\]|\(\?:|[^\\\[]")
LONGEST = 300
"""Letters of a pattern that is not just a name."""
MOST_STEPS = 3 * 10**7
"""Of all patterns on all names: some ten seconds."""

_Rest: TypeAlias = Callable[[int], int]
"""From the state after a part of a pattern to the first state of that part."""


def values_of(patterns: Mapping[str, Any], names: Collection[str], default: Any) -> dict[str, Any]:
    """By name, the value of the first pattern that is all of it, or all that follows a dot in it.

    As Hugging Face PEFT does (get_pattern_key of 0.21.2): re.match(rf"(.*\\.)?({pattern})$", name).

    Args:
      patterns: value by pattern.
      names: of modules, "a.0.b".
      default: value of a name that none matches.

    Raises:
      ValueError: what is no such pattern, or too many and too long ones.
    """
    matchers = [(_matcher(pattern), value) for pattern, value in patterns.items()]
    letters = sum(
        1 if _PLAIN.fullmatch(p) else len(p) * (max(map(len, names)) + 1) for p in patterns
    )
    if letters * len(names) > MOST_STEPS:
        raise ValueError(f"{len(patterns)} patterns for {len(names)} names take too long.")
    found = {}
    for name in names:
        hits = (value for matches, value in matchers if matches(name))
        found[name] = next(hits, default)
    return found


def _matcher(pattern: str) -> Callable[[str], Any]:
    """Whether a pattern is all of a name, or all that follows one of its dots."""
    if _PLAIN.fullmatch(pattern):  # Python needs no more than n m steps either
        return re.compile(rf"(?:.*\.)?(?:{pattern})$").match
    if len(pattern) > LONGEST:
        raise ValueError(f"a pattern has {len(pattern)} letters, more than {LONGEST}.")
    return _States(pattern).matches


class _States:
    """A pattern as states: what a letter must pass to leave one (None: no letter is needed, "^" and
    "$": a place), and which follow."""

    def __init__(self, pattern: str) -> None:
        self.pattern = pattern
        self.tokens = _TOKEN.findall(pattern)[::-1]
        self.states: list[tuple[Any, tuple[int, ...]]] = [(None, ())]  # 0 is the end
        if "".join(reversed(self.tokens)) != pattern:
            self._refuse()
        whole = self._options()
        if self.tokens:
            self._refuse()
        self.first = whole(0)

    def matches(self, name: str) -> bool:
        """See `_matcher`."""
        live = self._reached({self.first}, {"^"} if name else {"^", "$"})
        for place, letter in enumerate(name, start=1):
            passed = (self.states[state] for state in live)
            live = {s for test, after in passed if callable(test) and test(letter) for s in after}
            if letter == ".":
                live.add(self.first)
            live = self._reached(live, {"$"} if place == len(name) else set())
        return 0 in live

    def _reached(self, live: set[int], places: set[str]) -> set[int]:
        """These states, and those to which no letter is needed."""
        reached, left = set(live), list(live)
        while left:
            test, after = self.states[left.pop()]
            if test is None or test in places:
                left += set(after) - reached
                reached |= set(after)
        return reached

    def _add(self, test: Any, *after: int) -> int:
        self.states.append((test, after))
        return len(self.states) - 1

    def _taken(self, token: str) -> bool:
        """Whether this token is the next, which then is read."""
        return self.tokens[-1:] == [token] and bool(self.tokens.pop())

    def _options(self) -> _Rest:
        options = [self._sequence()]
        while self._taken("|"):
            options.append(self._sequence())
        return lambda after: self._add(None, *(option(after) for option in options))

    def _sequence(self) -> _Rest:
        parts = []
        while self.tokens and self.tokens[-1] not in ("|", ")"):
            parts.append(self._repeated())
        return lambda after: functools.reduce(lambda after, part: part(after), parts[::-1], after)

    def _repeated(self) -> _Rest:
        one = self._one()
        for mark in "*+?":
            if self._taken(mark):
                self._taken("?")  # as few as possible: the same names
                return functools.partial(self._repeat, one, mark)
        return one

    def _repeat(self, one: _Rest, mark: str, after: int) -> int:
        if mark == "?":
            return self._add(None, one(after), after)
        again = self._add(None)
        first = one(again)
        self.states[again] = None, (first, after)
        return first if mark == "+" else again

    def _one(self) -> _Rest:
        token = self.tokens.pop()
        if token in ("(", "(?:"):
            inside = self._options()
            if not self._taken(")"):
                self._refuse()
            return inside
        if token in "^$":
            return functools.partial(self._add, token)
        if token in "*+?{}":
            self._refuse()
        try:
            return functools.partial(self._add, re.compile(token).fullmatch)
        except re.error:  # a class such as [z-a]
            self._refuse()

    def _refuse(self) -> NoReturn:
        raise ValueError(
            f"the pattern {self.pattern!r} is not of letters, '.', classes, '|', groups, '*', '+', "
            "'?', '^' and '$'."
        )
