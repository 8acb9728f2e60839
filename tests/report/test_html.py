"""The report is self-contained and needs only the files of a run folder."""

import dataclasses
import json
import re

import pytest

from lorasp_jax.peft import LoRAMoE
from lorasp_jax.report import figures
from lorasp_jax.report.html import speed, write_report
from lorasp_jax.training.best import BEST
from lorasp_jax.training.run_folder import STOPPED, MetricsLog, to_json, write_json
from tests.runs import CONFIG, RESULTS, finish


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A finished run; drawing its figures takes most of a report's time."""
    monkeypatch.setattr(figures, "svg", lambda _: "<svg/>")
    return finish(tmp_path)


def test_report_shows_the_results_and_is_self_contained(folder, monkeypatch):
    monkeypatch.undo()
    page = write_report(folder).read_text()
    assert "75.0 % [63.2, 84.0] of 64" in page
    assert "3.1 % [0.9, 10.7] of 64" in page
    assert "10 trainable of 1,000 parameters (1.0 %)" in page
    assert "&lt;b&gt;run&lt;/b&gt;" in page
    assert "<b>run" not in page
    sources = re.findall(r'src="([^"]{5})', page)
    assert len(sources) == 6
    assert set(sources) == {"data:"}
    assert "http" not in re.sub(r'src="[^"]*"', "", page)


def test_histogram_is_drawn_if_recorded(folder):
    results = {**RESULTS, "active_rank_histogram": {"vision": [0, 3, 1], "action": [0, 0, 4]}}
    write_json(folder / "results.json", results)
    assert write_report(folder).read_text().count("image/svg") == 5


def test_full_fine_tuning_has_no_ranks(folder):
    config = {**to_json(CONFIG), "peft": {"method": "FullFineTuning"}}
    write_json(folder / "config.json", config)
    results = {**RESULTS, "active_rank": {}, "layer_active_rank": {"vision": {}}}
    write_json(folder / "results.json", results)
    (folder / "metrics.jsonl").write_text(json.dumps({"step": 2, "task": 0.5}) + "\n")
    assert "Active rank" not in write_report(folder).read_text()


@pytest.mark.parametrize("adapt", [(), ("vision=none", "language=lora_moe")])
def test_all_experts_of_a_mixture_fit_into_the_figure(folder, monkeypatch, adapt):
    ranks, config = [], dataclasses.replace(CONFIG, peft=LoRAMoE(experts=3, rank=2), adapt=adapt)
    monkeypatch.setattr(figures, "active_rank", lambda _, rank: ranks.append(rank))
    write_json(folder / "config.json", to_json(config))
    write_report(folder)
    assert ranks == [6]


def test_unfinished_run(folder):
    """There is a page from the start, with partial results."""
    before = {"press": RESULTS["tasks"]["press"]["before"]}
    for name in ("results.json", "rollout_press.mp4", "cameras_press.png"):
        (folder / name).unlink()
    write_json(folder / "before.json", before)
    page = write_report(folder).read_text()
    assert "Running: step 4 of 4." in page
    assert "http-equiv=refresh" in page
    assert "3.1 % [0.9, 10.7] of 64" in page
    assert "<th>before</th></tr>" in page
    assert page.count("image/svg") == 3
    for name in ("before.json", "metrics.jsonl"):
        (folder / name).unlink()
    page = write_report(folder).read_text()
    assert "step 0 of 4" in page
    assert "No metrics logged yet" in page
    assert "image/svg" not in page
    (folder / "config.json").unlink()
    with pytest.raises(ValueError, match="no run in"):
        write_report(folder)


def test_run_without_evaluation_of_the_base(folder):
    tasks = {task: {"after": value["after"]} for task, value in RESULTS["tasks"].items()}
    write_json(folder / "results.json", RESULTS | {"tasks": tasks})
    page = write_report(folder).read_text()
    assert "before" not in page.partition("<h2>Settings")[0]
    assert "<tr><th>task</th><th>after</th></tr>" in page
    assert "75.0 % [63.2, 84.0] of 64" in page


@pytest.mark.parametrize("source", ["", "recordings"])
def test_settings_that_a_dataset_replaces_are_not_shown(folder, source):
    data = dataclasses.replace(CONFIG.data, source=(source,))
    write_json(folder / "config.json", to_json(dataclasses.replace(CONFIG, data=data)))
    settings = write_report(folder).read_text().partition("<h2>Settings")[2]
    for name in ("tasks", "robot"):
        assert (f"&quot;{name}&quot;" in settings) == (not source)


def test_stopped_run_shows_the_reason(folder):
    assert "were skipped" not in write_report(folder).read_text()
    results = (folder / "results.json").read_text()
    (folder / "results.json").unlink()
    write_json(folder / STOPPED, {"reason": "the loss was <nan>"})
    with (folder / "metrics.jsonl").open("a") as file:
        rows = [{"step": s, "skipped": 2.0} for s in (6, 8)]
        file.writelines(json.dumps(row) + "\n" for row in rows)
    page = write_report(folder).read_text()
    assert "<b>The run stopped:</b> the loss was &lt;nan&gt;." in page
    assert "4 steps were skipped" in page
    assert "first logged at step 6, last at step 8" in page
    assert "http-equiv=refresh" not in page
    (folder / "results.json").write_text(results)  # resumed and finished
    assert "stopped" not in write_report(folder).read_text()


@pytest.mark.parametrize(
    ("step", "sentence"), [(3, "adapters of iteration 3"), (0, "No iteration was better")]
)
def test_run_that_learned_from_success_says_what_it_kept(folder, monkeypatch, step, sentence):
    monkeypatch.setattr(figures, "reinforcement", lambda *_: "<svg/>")
    write_json(folder / "config.json", to_json(CONFIG) | {"online": {"worlds": 8}})
    assert sentence not in write_report(folder).read_text()
    write_json(folder / BEST, {"step": step, "error": 0.4, "weights": ""})
    assert sentence in write_report(folder).read_text()


def test_run_that_is_evaluated_during_training(folder):
    (folder / "results.json").unlink()
    before = RESULTS["tasks"]["press"]["before"]
    write_json(folder / "before.json", dict.fromkeys(("press", "pour"), before))
    log = MetricsLog(folder)
    log.write(6, {"task": 0.1, "success/press": 0.5})
    log.close()
    page = write_report(folder).read_text()
    assert page.count("image/svg") == 3  # success before, losses, success over the steps
    assert page.count("<video") == 1  # pour has no video yet
    assert "<h3>pour" not in page


def test_median_speed_and_peak_memory(folder):
    assert "samples/s" not in write_report(folder).read_text()
    log = MetricsLog(folder)
    for step, (rate, peak) in enumerate([(1.0, 2.0), (30.0, 3.5), (20.0, 1.0)]):
        log.write(step, {"task": 1.0, "speed/samples_per_second": rate, "memory/peak_gib": peak})
    log.close()
    page = write_report(folder).read_text()
    assert "samples/s</td><td class=number>20<" in page
    assert "3.50 GiB" in page
    assert "data wait" not in page


def test_data_wait_is_a_fraction_of_all_time():
    rate, wait = "speed/samples_per_second", "speed/data_wait"
    rows = [{rate: 10.0}, {rate: 10.0, wait: 0.0}, {rate: 5.0, wait: 0.5}]  # 1, 1 and 2 seconds
    assert speed(rows)["data wait"] == "25.0%"
    assert speed([{"memory/peak_gib": 3 / 1024}]) == {"peak memory": "3.0 MiB"}


@pytest.mark.parametrize("name", ["cameras_press.png", "rollout_press.mp4"])
def test_missing_media_are_named(folder, name):
    (folder / name).unlink()
    page = write_report(folder).read_text()
    assert f"Missing: {name}." in page
    assert "75.0 % [63.2, 84.0] of 64" in page
