"""Bars say how fast things go."""

import io
from types import SimpleNamespace

import pytest
from rich.console import Console

from lorasp_jax.training.run import bars


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


def test_slow_steps_have_a_rate_too():
    progress, now = bars(Console(file=io.StringIO()), "samples"), [0.0]
    progress.get_time = lambda: now[0]
    bar = progress.add_task("training", total=100)
    for now[0], done in ((60.0, 50), (120.0, 52), (180.0, 54)):
        progress.update(bar, completed=done)
    assert progress.tasks[bar].time_remaining == pytest.approx(46 / (4 / 120), rel=0.5)
