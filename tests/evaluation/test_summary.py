"""results.json has the documented fields."""

import dataclasses
import json

import numpy as np
import pytest

from lorasp_jax.evaluation import Result, callback
from lorasp_jax.evaluation.callback import Evaluation, success, summarize
from lorasp_jax.training import records
from lorasp_jax.training.run_folder import read_json, write_json
from tests.runs import make_run

RANKS = {"vision": {"fc1": [4.0, 6.0]}, "language": {}, "action": {"q_proj": [1.0]}}


def result(rate, ranks):
    counts = {tower: np.array([0, 2, 1]) for tower in ranks}
    outcomes = tuple(episode < 10 * rate for episode in range(10))
    return Result(rate, 10, (rate - 0.1, rate + 0.1), outcomes, 30.0, ranks, counts, poses=())


def test_summary(tmp_path):
    run = make_run(tmp_path / "run")
    before = {task: success(result(0.1, {})) for task in run.config.tasks}
    write_json(run.folder / "before.json", before)
    with run.timed("train"):
        pass
    after = {"press": result(0.9, RANKS), "pick_place": result(0.5, RANKS)}
    summary = json.loads(json.dumps(summarize(run, after)))
    assert summary["scale"] == "smoke"
    assert summary["tasks"]["press"]["before"] == {
        "success": 0.1,
        "episodes": 10,
        "ci95": [0.0, 0.2],
        "outcomes": "1000000000",
    }
    assert summary["tasks"]["pick_place"]["after"]["success"] == 0.5
    assert summary["tasks"]["pick_place"]["after"]["outcomes"] == "1111100000"
    assert summary["active_rank"] == {"vision": 5.0, "action": 1.0, "mean": pytest.approx(11 / 3)}
    assert summary["active_rank_histogram"] == {tower: [0, 4, 2] for tower in RANKS}
    assert summary["seconds"].keys() == {"train", "total"}
    assert 0 < summary["trainable_parameters"] < summary["total_parameters"]


def test_summary_without_evaluation_of_the_base(tmp_path, monkeypatch):
    run = make_run(tmp_path / "run")
    settings = dataclasses.replace(run.config.evaluation, before=False)
    run.config = dataclasses.replace(run.config, evaluation=settings)
    monkeypatch.setattr(callback, "evaluate", lambda *_, **__: pytest.fail("evaluated"))
    Evaluation().on_start(run)
    assert not (run.folder / "before.json").exists()
    summary = summarize(run, {"press": result(0.9, RANKS)})
    assert summary["tasks"]["press"].keys() == {"after"}
    write_json(run.folder / "results.json", summary)
    assert read_json(run.folder / "results.json", records.RESULTS)["tasks"] == summary["tasks"]


def test_time_accumulates_over_processes(tmp_path):
    run = make_run(tmp_path / "run")
    with pytest.raises(KeyboardInterrupt), run.timed("train"):
        raise KeyboardInterrupt
    write_json(run.folder / "seconds.json", {"train": 100.0, "total": 200.0})
    again = make_run(tmp_path / "run")
    with again.timed("train"):
        pass
    recorded = read_json(run.folder / "seconds.json")
    assert 100 < recorded["train"] < 110
    assert 200 < recorded["total"] < 260
