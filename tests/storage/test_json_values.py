"""Values of a JSON file are checked where it is read."""

import re

import pytest

from lorasp_jax.storage.json_values import check


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        *[(1, int), (1, float), (1.5, float), (-1e38, float), (False, bool), ("x", str)],
        *[([], [float]), ([1, 2.5], [float]), ([1, 2], (float, float)), ({}, {}), ({"a": 1}, {})],
        *[({"a": 1, "b": None}, {"a": int}), ({"x": {"y": [0]}}, {str: {str: [int]}})],
    ],
)
def test_what_is_right(value, kind):
    check(value, kind)


@pytest.mark.parametrize(
    ("value", "kind", "sentence"),
    [
        (True, int, "x must be a whole number, not True"),
        (1.5, int, "x must be a whole number, not 1.5"),
        (10**39, int, "x must be a whole number, not 1000"),
        (False, float, "x must be a number, not False"),
        (float("nan"), float, "x must be a number, not nan"),
        (float("inf"), float, "x must be a number, not inf"),
        ("1", float, "x must be a number, not '1'"),
        (1, bool, "x must be a flag, not 1"),
        (None, str, "x must be a text, not None"),
        ({}, [int], "x must be a list, not {}"),
        ([1], (int, int), "x must be a list of 2, not [1]"),
        ([1, "a"], [int], "x[1] must be a whole number, not 'a'"),
        ([], {}, "x must be an object, not []"),
        ({"a": {}}, {"a": {"b": int}}, "x.a lacks 'b'"),
        ({"a": {"c": 0.5}}, {str: {str: int}}, "x.a.c must be a whole number, not 0.5"),
    ],
)
def test_what_is_wrong_is_named(value, kind, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        check(value, kind, "x")
