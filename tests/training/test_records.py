"""Fields of a run's files are validated when they are read."""

import re

import pytest

from lorasp_jax.report.html import write_report
from lorasp_jax.training.run_folder import CONFIG_FILE, read_json, write_json
from tests.runs import RESULTS, finish

OUTCOMES = {"success": 0.5, "episodes": 2, "ci95": [0.1, 0.9], "outcomes": [1, 0]}
BOTH = {"before": OUTCOMES, "after": OUTCOMES}


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("tasks", {"press": {"success": 0.5}}, "tasks.press lacks 'after'"),
        ("tasks", {"press": BOTH}, "tasks.press.before.outcomes must be a string, got [1, 0]"),
        ("tasks", 5, "tasks must be an object, got 5"),
        ("seconds", {"train": "long"}, "seconds.train must be a number, got 'long'"),
        ("layer_active_rank", {"vision": [1]}, "layer_active_rank.vision must be an object"),
        ("total_parameters", None, "total_parameters must be a whole number"),
    ],
)
def test_results_of_another_version(name, value, sentence, tmp_path):
    finish(tmp_path)
    write_json(tmp_path / "results.json", RESULTS | {name: value})
    with pytest.raises(ValueError, match=rf"results\.json is damaged \({re.escape(sentence)}"):
        write_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


@pytest.mark.parametrize(
    ("peft", "sentence"), [({}, "peft lacks 'rank'"), ({"rank": []}, "peft.rank must be a whole")]
)
def test_settings_of_another_version(peft, sentence, tmp_path):
    finish(tmp_path)
    config = read_json(tmp_path / CONFIG_FILE)
    write_json(tmp_path / CONFIG_FILE, config | {"peft": {"method": "LoRASP"} | peft})
    with pytest.raises(ValueError, match=rf"config\.json is damaged \({re.escape(sentence)}"):
        write_report(tmp_path)
