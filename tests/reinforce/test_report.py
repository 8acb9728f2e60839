"""The report of online learning."""

import base64
import re
from types import SimpleNamespace

import numpy as np
import pytest

from lorasp_jax.reinforce import films
from lorasp_jax.report import figures
from lorasp_jax.report.html import write_report
from lorasp_jax.training.run_folder import MetricsLog, to_json, write_json
from tests.reinforce import rooms

ROWS = [
    {
        "step": step,
        "rollout/press": 0.5 + 0.1 * step,
        "environment_steps": 1000.0 * step,
        "minutes": 0.5 * step,
        "start_kl": 0.1 * step,
        "updates": 8.0,
    }
    for step in (1, 2, 3)
]


def test_a_report_shows_success_over_steps_and_minutes(tmp_path):
    write_json(tmp_path / "config.json", to_json(rooms.config()))
    log = MetricsLog(tmp_path)
    for row in ROWS:
        values = {name: value for name, value in row.items() if name != "step"}
        log.write(int(row["step"]), values)
    log.close()
    page = write_report(tmp_path).read_text()
    drawn = [base64.b64decode(x).decode() for x in re.findall(r"svg\+xml;base64,([^\"]+)", page)]
    assert any("environment steps" in figure and "minutes" in figure for figure in drawn)
    assert not any("flow-matching loss" in figure for figure in drawn)


@pytest.mark.parametrize(
    ("before", "after", "world"),
    [([0, 1, 0, 0], [0, 1, 0, 1], 3), ([0, 1, 1], [0, 1, 1], 1), ([1, 0, 0], [0, 0, 0], 0)],
)
def test_films_show_a_success_where_the_start_failed(tmp_path, monkeypatch, before, after, world):
    def rollout(policy, _):
        success = np.array(policy.success, bool)
        poses = 100 * np.arange(5)[:, None] + np.arange(len(success))
        return SimpleNamespace(success=success, steps=2 + success, poses=poses, draw=None)

    def write(_, poses, path, draw):
        path.write_text(" ".join(map(str, poses)))

    class Fixed(SimpleNamespace):
        def with_sampler(self):
            return self

    monkeypatch.setattr(films, "compiled_rollout", lambda *_: (None, rollout))
    monkeypatch.setattr(films.video, "write_episode", write)
    run = SimpleNamespace(config=rooms.config(), folder=tmp_path, policy=Fixed(success=after))
    films.Films(Fixed(success=before)).on_end(run)
    for name, success in (("start", before), ("rollout", after)):
        frames = [100 * i + world for i in range(2 + success[world])]
        assert (tmp_path / f"{name}_press.mp4").read_text() == " ".join(map(str, frames))


@pytest.mark.parametrize("rows", [ROWS, [{k: v for k, v in ROWS[0].items() if k != "start_kl"}]])
def test_success_has_intervals(rows):
    figure = figures.reinforcement(rows, 64)
    steps, minutes, right = figure.axes
    for axes, scale in ((steps, 1000), (minutes, 0.5)):
        x, y = axes.lines[0].get_data()
        assert [*x] == pytest.approx([scale * row["step"] for row in rows])
        assert [*y] == pytest.approx([100 * row["rollout/press"] for row in rows])
        low, high = axes.collections[0].get_paths()[0].vertices[:, 1].min(), max(y)
        assert low < 50 < high
    assert len(right.lines) == ("start_kl" in rows[0])
