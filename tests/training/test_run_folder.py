"""Run folders: nothing is overwritten, logs continue."""

import dataclasses
import json

import pytest

from lorasp_jax.config import Config, DataConfig
from lorasp_jax.peft import LoRASP
from lorasp_jax.training.run_folder import MetricsLog, open_run, read_metrics

CONFIG = Config(name="a", scale="cpu", peft=LoRASP(rank=8))


def test_second_run_in_one_folder_is_refused(tmp_path):
    folder = open_run(CONFIG, tmp_path, resume=False)
    (folder / "metrics.jsonl").write_text("kept")
    with pytest.raises(ValueError, match="already holds a run"):
        open_run(CONFIG, tmp_path, resume=False)
    assert (folder / "metrics.jsonl").read_text() == "kept"


def test_resume_needs_the_same_settings(tmp_path):
    with pytest.raises(ValueError, match="no run to resume"):
        open_run(CONFIG, tmp_path, resume=True)
    folder = open_run(CONFIG, tmp_path, resume=False)
    assert open_run(CONFIG, tmp_path, resume=True) == folder
    other = dataclasses.replace(CONFIG, peft=LoRASP(rank=4), seed=3)
    with pytest.raises(ValueError, match=r"other settings \(peft\.alpha.*seed|peft\.rank, seed"):
        open_run(other, tmp_path, resume=True)
    assert json.loads((folder / "config.json").read_text())["peft"]["rank"] == 8


def test_damaged_record(tmp_path):
    folder = open_run(CONFIG, tmp_path, resume=False)
    (folder / "config.json").write_text("{")
    with pytest.raises(ValueError, match="is damaged"):
        open_run(CONFIG, tmp_path, resume=True)


def test_log_continues_like_an_uninterrupted_one(tmp_path):
    log = MetricsLog(tmp_path)
    for step in (2, 4, 6):
        log.write(step, {"loss": float(step)})
    log.close()
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 8, "lo')  # killed while writing
    log = MetricsLog(tmp_path, start_step=4)
    log.write(6, {"loss": -6.0})
    log.close()
    assert [row["loss"] for row in read_metrics(tmp_path)] == [2.0, 4.0, -6.0]
    assert list((tmp_path / "tensorboard").iterdir())


def test_json_has_no_numbers_that_are_not_finite(tmp_path):
    log = MetricsLog(tmp_path)
    log.write(2, {"loss": float("nan"), "grad_norm": float("inf"), "skipped": 2.0})
    log.close()
    assert read_metrics(tmp_path) == [{"step": 2, "skipped": 2.0}]


def test_name_is_free_after_a_run_that_failed_before_it_had_anything(tmp_path):
    """As with an expert that fails under too much noise."""
    noisy = dataclasses.replace(CONFIG, data=DataConfig(action_noise=0.1))
    folder = open_run(noisy, tmp_path, resume=False)
    (folder / "seconds.json").write_text('{"collect": 9.0, "total": 9.0}')
    assert open_run(CONFIG, tmp_path, resume=False) == folder
    assert [path.name for path in folder.iterdir()] == ["config.json"]  # the clock starts anew
    assert json.loads((folder / "config.json").read_text())["data"]["action_noise"] == 0.005


@pytest.mark.parametrize("more", ["cache/pick_place.npz", "before.json"])
def test_a_run_that_has_something_is_kept(tmp_path, more):
    folder = open_run(CONFIG, tmp_path, resume=False)
    (folder / more).parent.mkdir(exist_ok=True)
    (folder / more).write_text("more")
    with pytest.raises(ValueError, match="already holds a run: add --resume"):
        open_run(dataclasses.replace(CONFIG, seed=1), tmp_path, resume=False)
    assert (folder / more).read_text() == "more"
    assert json.loads((folder / "config.json").read_text())["seed"] == 0
