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


def test_nulls_of_other_projects():
    kind = {"a": [{"b?": int}]}
    check({"a": [{"b": None}]}, kind, nulls=True)
    for value, nulls in (({"a": [{"b": None}]}, False), ({"a": None}, True)):
        with pytest.raises(ValueError, match=r"^a"):
            check(value, kind, nulls=nulls)


@pytest.mark.parametrize(
    ("value", "kind", "name"),
    [
        *[(bad, int, "x") for bad in (True, 1.5, 10**39)],
        *[(bad, float, "x") for bad in (False, float("nan"), float("inf"), "1")],
        *[(1, bool, "x"), (None, str, "x"), ({}, [int], "x"), ([1], (int, int), "x")],
        *[
            ([1, "a"], [int], "x[1]"),
            ([], {}, "x"),
            ({"a": {}}, {"a": {"b": int}}, "x.a lacks 'b'"),
        ],
        *[({"a": "1"}, {"a?": int}, "x.a"), ({"a": {"c": 0.5}}, {str: {str: int}}, "x.a.c")],
    ],
)
def test_invalid_values_are_named(value, kind, name):
    with pytest.raises(ValueError, match=f"^{re.escape(name)}"):
        check(value, kind, "x")
