"""Text of progress bars."""

import io
import threading
from types import SimpleNamespace

import pytest
from rich.console import Console

from lorasp_jax.base.bars import bars, collecting


@pytest.mark.parametrize(
    ("per_step", "speed", "finished", "text"),
    [
        (64, 2.0, None, "128 samples/s"),
        (512, 40.0, None, "20,480 samples/s"),
        (1, 0.025, None, "0.025 samples/s"),
        (1, None, None, ""),  # nothing done yet, or everything at once
        (2, 3.0, 5.0, "10 samples/s"),  # mean over the whole time, once it is over
    ],
)
def test_rate_counts_units_not_steps(per_step, speed, finished, text):
    rate = bars(Console(file=io.StringIO()), "samples", per_step=per_step).columns[-1]
    task = SimpleNamespace(speed=speed, finished_speed=finished, fields={})
    assert rate.render(task).plain == text
    measured = SimpleNamespace(**vars(task) | {"fields": {"rate": 50.0}})  # without callbacks
    assert rate.render(measured).plain == "50 samples/s"


def test_slow_steps_have_a_rate_too():
    progress, now = bars(Console(file=io.StringIO()), "samples"), [0.0]
    progress.get_time = lambda: now[0]
    bar = progress.add_task("training", total=100)
    for now[0], done in ((60.0, 50), (120.0, 52), (180.0, 54)):
        progress.update(bar, completed=done)
    assert progress.tasks[bar].time_remaining == pytest.approx(46 / (4 / 120), rel=0.5)


@pytest.mark.parametrize("terminal", [False, True])
def test_a_file_gets_a_line_now_and_then(terminal):
    text, now = io.StringIO(), [0.0]
    progress = bars(Console(file=text, force_terminal=terminal, width=80), "samples")
    progress.get_time = lambda: now[0]
    bar, progress._said = progress.add_task("training", total=100), 0.0
    for now[0], done in ((1.0, 1), (31.0, 20), (32.0, 21), (62.0, 40)):
        progress.update(bar, completed=done, rate=5.0)
    lines = text.getvalue().splitlines()
    assert [line.split()[1] for line in lines] == ([] if terminal else ["20/100", "40/100"])
    assert "\r" not in text.getvalue()
    assert terminal or (lines[1].startswith("training") and lines[1].endswith("5 samples/s"))


@pytest.mark.parametrize("kept", [0, 8])
def test_compiling_is_not_in_the_rate(kept):
    """Compilation ends with the first episodes, also in a resumed collection."""
    progress, now = bars(Console(file=io.StringIO()), "episodes"), [0.0]
    progress.get_time = lambda: now[0]
    report = collecting(progress, "press, piper", threading.Event())
    for now[0], done, speed in ((1.0, kept, None), (60.0, 32, None), (64.0, 64, 8.0)):
        report(done, 96)
        (task,) = progress.tasks
        assert task.speed == speed
        assert task.description.endswith("compiling ..." if now[0] == 1 else "collecting")


def test_no_bar_before_the_first_report_and_none_after_a_stop():
    progress, stop = bars(Console(file=io.StringIO()), "episodes"), threading.Event()
    collecting(progress, "dance, piper", stop)
    report = collecting(progress, "press, piper", stop)
    report(0, 1)
    assert [task.description for task in progress.tasks] == ["press, piper: compiling ..."]
    stop.set()
    with pytest.raises(KeyboardInterrupt):
        report(1, 1)
