"""Parametrized tests that run most of their cases only with the slow tests."""

from collections.abc import Iterable
from typing import Any

import pytest


def mostly_slow(cases: Iterable[Any], quick: Iterable[Any]) -> list[Any]:
    """Mark all cases as slow, except those in `quick`."""
    fast = list(quick)
    return [c if c in fast else pytest.param(c, marks=pytest.mark.slow) for c in cases]
