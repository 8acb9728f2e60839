"""Patterns match module names as in PEFT, in bounded time."""

import re
import time

import pytest

from lorasp_jax.adapters.io.name_patterns import values_of

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
    *("^model$", "$", "a|b", "(^a|b)b?", r"\w+", "", "a{2}", "(layers)*", r"[\w-]+\.a"),
]


@pytest.mark.parametrize("pattern", PATTERNS)
def test_matches_are_those_of_peft(pattern):
    values = values_of({pattern: True}, NAMES, default=False)
    assert values == {n: bool(re.match(rf"(.*\.)?({pattern})$", n)) for n in NAMES}


def test_the_first_match_wins():
    values = values_of({"0.q": 1, "q": 2}, ["x.0.q", "x.1.q", "k"], default=3)
    assert values == {"x.0.q": 1, "x.1.q": 2, "k": 3}


@pytest.mark.parametrize(
    "pattern", ["(a+)+b", "(a|a)*b", "(.*)*b", "a?" * 60 + "a" * 60, "(((a*)*)*)*b", ".*.*.*.*.*b"]
)
def test_catastrophic_patterns_are_rejected(pattern):
    names = [f"{'a' * 250}{i}" for i in range(20)]
    with pytest.raises(ValueError, match="too long"):
        values_of({pattern: True}, names, default=False)


def test_accepted_patterns_take_seconds():
    """The slowest accepted pattern, close to the limit, in process time."""
    names = [f"{'a' * 170}{i}" for i in range(50)]
    start = time.process_time()
    assert not any(values_of({".*a.*b": True}, names, default=False).values())
    assert time.process_time() - start < 10


@pytest.mark.parametrize("pattern", ["a)", "(a", "[a", "*a", "a**", "[z-a]", "a\\"])
def test_invalid_regular_expressions(pattern):
    with pytest.raises(ValueError, match="regular expression"):
        values_of({pattern: 1}, ["a"], default=2)


@pytest.mark.parametrize("pattern", [r"(?=a)", r"(a)\1", "a++"])
def test_unsupported_constructs(pattern):
    with pytest.raises(ValueError, match=r"[A-Z_]+ is not supported"):
        values_of({pattern: 1}, ["a"], default=2)
