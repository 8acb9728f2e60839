"""The report: self-contained, from the files of a run folder alone."""

import json
import re

import pytest

from lorasp_jax.report.html import speed, write_report
from lorasp_jax.storage.digest import sealed
from lorasp_jax.training.run_folder import STOPPED, MetricsLog, to_json, write_json
from tests.runs import CONFIG, RESULTS, finish


@pytest.fixture
def folder(tmp_path):
    return finish(tmp_path)


def test_report_shows_the_results_and_needs_no_other_file(folder):
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


def test_histogram_is_drawn_where_it_was_recorded(folder):
    results = {**RESULTS, "active_rank_histogram": {"vision": [0, 3, 1], "action": [0, 0, 4]}}
    write_json(folder / "results.json", results)
    assert write_report(folder).read_text().count("image/svg") == 5


def test_full_fine_tuning_has_no_ranks(folder):
    config = {**to_json(CONFIG), "peft": {"method": "FullFineTuning"}}
    write_json(folder / "config.json", config)
    results = {**RESULTS, "active_rank": {}, "layer_active_rank": {"vision": {}}}
    write_json(folder / "results.json", results)
    (folder / "metrics.jsonl").write_text(json.dumps(sealed({"step": 2, "task": 0.5})) + "\n")
    assert "Active rank" not in write_report(folder).read_text()


def test_a_run_that_goes_on(folder):
    """From the first moment on there is a page, with what is known."""
    before = {"press": RESULTS["tasks"]["press"]["before"]}
    for name in ("results.json", "rollout_press.mp4", "cameras_press.png"):
        (folder / name).unlink()
    write_json(folder / "before.json", before)
    page = write_report(folder).read_text()
    assert "The run goes on: step 4 of 4." in page
    assert "http-equiv=refresh" in page
    assert "3.1 % [0.9, 10.7] of 64" in page
    assert "<th>before</th></tr>" in page
    assert page.count("image/svg") == 3
    for name in ("before.json", "metrics.jsonl"):
        (folder / name).unlink()
    page = write_report(folder).read_text()
    assert "step 0 of 4" in page
    assert "Nothing is logged yet" in page
    assert "image/svg" not in page
    (folder / "config.json").unlink()
    with pytest.raises(ValueError, match="holds no run"):
        write_report(folder)


def test_a_run_that_stopped_says_why(folder):
    assert "were skipped" not in write_report(folder).read_text()
    results = (folder / "results.json").read_text()
    (folder / "results.json").unlink()
    write_json(folder / STOPPED, {"reason": "the loss was <nan>"})
    with (folder / "metrics.jsonl").open("a") as file:
        rows = [sealed({"step": s, "skipped": 2.0}) for s in (6, 8)]
        file.writelines(json.dumps(row) + "\n" for row in rows)
    page = write_report(folder).read_text()
    assert "<b>The run stopped:</b> the loss was &lt;nan&gt;." in page
    assert "4 steps were skipped" in page
    assert "the first up to step 6, the last up to 8" in page
    assert "http-equiv=refresh" not in page
    (folder / "results.json").write_text(results)  # resumed and finished after all
    assert "stopped" not in write_report(folder).read_text()


def test_a_run_that_is_evaluated_while_it_goes_on(folder):
    (folder / "results.json").unlink()
    before = RESULTS["tasks"]["press"]["before"]
    write_json(folder / "before.json", dict.fromkeys(("press", "pour"), before))
    log = MetricsLog(folder)
    log.write(6, {"task": 0.1, "success/press": 0.5})
    log.close()
    page = write_report(folder).read_text()
    assert page.count("image/svg") == 3  # success before, losses, success over the steps
    assert page.count("<video") == 1  # pour is not filmed yet
    assert "<h3>pour" not in page


def test_speed_is_the_middle_and_memory_the_highest(folder):
    assert "samples a second" not in write_report(folder).read_text()
    log = MetricsLog(folder)
    for step, (rate, used) in enumerate([(1.0, 2.0), (30.0, 3.5), (20.0, 1.0)]):
        log.write(step, {"task": 1.0, "speed/samples_per_second": rate, "memory/peak_gib": used})
    log.close()
    page = write_report(folder).read_text()
    assert "samples a second</td><td class=number>20<" in page
    assert "3.50 GiB" in page
    assert "waiting" not in page


def test_small_memory_is_not_zero(folder):
    assert speed([{"memory/peak_gib": 3 / 1024}]) == {"memory at its highest": "3.0 MiB"}


def test_a_phone_shows_the_page_at_its_own_width_light_or_dark(folder):
    page = write_report(folder).read_text()
    assert "<meta name=viewport content='width=device-width, initial-scale=1'>" in page
    style = page.partition("<style>")[2].partition("</style>")[0]
    assert "color-scheme: light dark" in style
    assert "@media (prefers-color-scheme: dark)" in style
    assert not re.search(r"#[0-9a-f]{3,6}", style.partition("body {")[2])  # only by name below


def test_waiting_is_a_share_of_all_time():
    rate, wait = "speed/samples_per_second", "speed/data_wait"
    rows = [{rate: 10.0}, {rate: 10.0, wait: 0.0}, {rate: 5.0, wait: 0.5}]  # 1, 1 and 2 seconds
    assert speed(rows)["time waiting for data"] == "25.0%"


def test_video_can_be_read_back(folder):
    import av

    with av.open(str(folder / "rollout_press.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height, stream.codec_context.pix_fmt) == (64, 32, "yuv420p")
        assert sum(1 for _ in container.decode(stream)) == 4


@pytest.mark.parametrize("name", ["cameras_press.png", "rollout_press.mp4"])
def test_pictures_that_are_gone_are_named(folder, name):
    (folder / name).unlink()
    page = write_report(folder).read_text()
    assert f"{name} missing." in page
    assert "75.0 % [63.2, 84.0] of 64" in page
