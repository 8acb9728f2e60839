"""Patterns over names of modules: what PEFT's own matching gives, in bounded time."""

import random
import re
import time

import pytest

from lorasp_jax import name_patterns
from lorasp_jax.name_patterns import values_of

NAMES = [
    *("q_proj", "model.layers.0.q_proj", "model.layers.10.self_attn.q_proj", "layers.0.mlp.up"),
    *("head", "lm_head", "a", "aa", "aab", "a.b", "ab.a", "b.aab", "..", "model.layers.1"),
]
PATTERNS = [
    *(
        "q_proj",
        "^q_proj",
        r"layers\.0\.q_proj",
        "layers.0.q_proj",
        ".*",
        r".*\.0\..*_proj",
        "head",
    ),
    *(
        r"layers\.(0|1[0-9]?)\..*",
        r"layers\.\d+",
        "[^.]+",
        "(?:a|b)+",
        "a?a?b",
        "(a|ab)(b|)",
        "a*?b",
    ),
    *("^model$", "$", "a|b", "(^a|b)b?", r"\w+", "(a+)+b", "", "(a*)*", r"[\w-]+\.a"),
]


@pytest.mark.parametrize("pattern", PATTERNS)
def test_as_peft_matches(pattern):
    found = values_of({pattern: True}, NAMES, default=False)
    assert found == {n: bool(re.match(rf"(.*\.)?({pattern})$", n)) for n in NAMES}


def test_random_patterns_as_peft_matches():
    r = random.Random(0)
    for _ in range(300):
        pattern = part(r, 3)
        names = ["".join(r.choices("ab.", k=r.randrange(1, 7))) for _ in range(5)]
        expected = {n: bool(re.match(rf"(.*\.)?({pattern})$", n)) for n in names}
        assert values_of({pattern: True}, names, default=False) == expected, pattern


def part(r, depth):
    """A pattern over a and b."""
    kind = r.randrange(6 if depth else 2)
    if kind < 2:
        return r.choice(["a", "b", ".", r"\.", "[ab]", "[^a]"])
    if kind == 2:
        return f"({part(r, depth - 1)}|{part(r, depth - 1)})"
    if kind == 3:
        return f"({part(r, depth - 1)}){r.choice(['*', '+', '?', '*?'])}"
    return part(r, depth - 1) + part(r, depth - 1)


def test_the_first_that_matches():
    found = values_of({"0.q": 1, "q": 2}, ["x.0.q", "x.1.q", "k"], default=3)
    assert found == {"x.0.q": 1, "x.1.q": 2, "k": 3}


@pytest.mark.parametrize(
    "pattern", ["(a+)+b", "(a|a)*b", "(.*)*b", "a?" * 60 + "a" * 60, "(((a*)*)*)*b", ".*.*.*.*.*b"]
)
def test_patterns_that_take_python_for_ever(pattern):
    """Seconds of this process, not of the clock; twenty names of 250 letters."""
    names = [f"{'a' * 250}{i}" for i in range(20)]
    began = time.process_time()
    assert not any(values_of({pattern: True}, names, default=False).values())
    assert time.process_time() - began < 10


@pytest.mark.parametrize(
    "pattern",
    [
        *(r"(?=a)", r"a{3}", r"(a)\1", "a)", "(a", "[a", "*a", "a**", "a++", r"\Z", "(?P<x>a)"),
        *("[[a]]", "[z-a]", "a\\"),
    ],
)
def test_what_is_not_understood(pattern):
    with pytest.raises(ValueError, match=r"is not of letters, '\.', classes"):
        values_of({pattern: 1}, ["a"], default=2)


def test_too_much(monkeypatch):
    with pytest.raises(ValueError, match="a pattern has 301 letters, more than 300"):
        values_of({"(" + "a" * 300: 1}, ["a"], default=2)
    monkeypatch.setattr(name_patterns, "MOST_STEPS", 100)
    assert values_of(dict.fromkeys(map(str, range(50)), 1), ["a", "b"], default=2) == {
        "a": 2,
        "b": 2,
    }
    with pytest.raises(ValueError, match="2 patterns for 50 names take too long"):
        values_of({"a+": 1, "b+": 2}, [f"name{i}" for i in range(50)], default=2)
