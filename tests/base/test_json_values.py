"""JSON values are checked against a schema."""

import re

import pytest

from lorasp_jax.base.json_values import check


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        *[(1, int), (1, float), (1.5, float), (-1e38, float), (False, bool), ("x", str)],
        *[([], [float]), ([1, 2.5], [float]), ([1, 2], (float, float)), ({}, {}), ({"a": 1}, {})],
        *[({"a": 1, "b": None}, {"a": int}), ({"x": {"y": [0]}}, {str: {str: [int]}})],
        *[({}, {"a?": int}), ({"a": 1}, {"a?": int}), ({"a": 1, "b": "x"}, {"a?": int, str: str})],
    ],
)
def test_valid_values(value, kind):
    check(value, kind)


@pytest.mark.parametrize(
    ("value", "kind", "message"),
    [
        (True, int, "x must be a whole number, got True"),
        (1.5, int, "x must be a whole number, got 1.5"),
        (10**39, int, "x must be a whole number, got 1000"),
        (False, float, "x must be a number, got False"),
        (float("nan"), float, "x must be a number, got nan"),
        (float("inf"), float, "x must be a number, got inf"),
        ("1", float, "x must be a number, got '1'"),
        (1, bool, "x must be true or false, got 1"),
        (None, str, "x must be a string, got None"),
        ({}, [int], "x must be a list, got {}"),
        ([1], (int, int), "x must be a list of 2, got [1]"),
        ([1, "a"], [int], "x[1] must be a whole number, got 'a'"),
        ([], {}, "x must be an object, got []"),
        ({"a": {}}, {"a": {"b": int}}, "x.a lacks 'b'"),
        ({"a": "1"}, {"a?": int}, "x.a must be a whole number, got '1'"),
        ({"a": {"c": 0.5}}, {str: {str: int}}, "x.a.c must be a whole number, got 0.5"),
    ],
)
def test_invalid_values_are_named(value, kind, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        check(value, kind, "x")
