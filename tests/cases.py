"""Parametrized tests whose every case is run only with the slow ones."""

from collections.abc import Iterable
from typing import Any

import pytest


def mostly_slow(cases: Iterable[Any], quick: Iterable[Any]) -> list[Any]:
    """The cases, all but some of them marked as slow."""
    chosen = list(quick)
    return [c if c in chosen else pytest.param(c, marks=pytest.mark.slow) for c in cases]
