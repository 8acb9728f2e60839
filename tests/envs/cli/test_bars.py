"""What progress bars say."""

import io
import threading

import pytest
from rich.console import Console

from envs.cli import bars


@pytest.mark.parametrize(
    ("episodes", "seconds", "text"),
    [(0, 9.0, ""), (1, 40.0, "40.0 s an episode"), (64, 20.0, "3.2 episodes/s")],
)
def test_a_rate_is_never_zero(episodes, seconds, text):
    assert bars._rate(episodes, seconds) == text


def test_compiling_is_not_in_the_rate(monkeypatch):
    """It ends with the first episodes."""
    progress, now, shown = bars.Progress, [0.0], []
    monkeypatch.setattr(
        bars, "Progress", lambda *a, **k: shown.append(progress(*a, **k)) or shown[0]
    )
    with bars.bars(Console(file=io.StringIO()), threading.Event()) as new_bar:
        shown[0].get_time = lambda: now[0]
        report = new_bar("press", "piper")
        for now[0], done, rate in ((1.0, 0, ""), (60.0, 32, ""), (64.0, 64, "8.0 episodes/s")):
            report(done, 64)
            assert shown[0].tasks[0].fields["rate"] == rate


def test_what_is_refused_has_no_bar():
    console = Console(file=io.StringIO())
    with bars.bars(console, threading.Event()) as new_bar:
        new_bar("dance", "piper")
        new_bar("press", "piper")(0, 1)
    shown = console.file.getvalue()
    assert "press, piper: compiling ..." in shown
    assert "dance" not in shown
