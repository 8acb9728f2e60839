"""Bars say how fast things go."""

import io
from types import SimpleNamespace

import pytest
from rich.console import Console

from lorasp_jax.training.progress import bars


@pytest.mark.parametrize(
    ("per_step", "speed", "finished", "text"),
    [
        (64, 2.0, None, "128 samples/s"),
        (512, 40.0, None, "20,480 samples/s"),
        (1, 0.25, None, "0.25 samples/s"),
        (1, None, None, ""),  # nothing done yet, or all at once
        (2, 3.0, 5.0, "10 samples/s"),  # over the whole time, once it is over
    ],
)
def test_rate_counts_units_not_steps(per_step, speed, finished, text):
    rate = bars(Console(file=io.StringIO()), "samples", per_step=per_step).columns[-1]
    assert rate.render(SimpleNamespace(speed=speed, finished_speed=finished)).plain == text
