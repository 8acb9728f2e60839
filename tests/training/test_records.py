"""Fields of a run's files are checked where they are read."""

import re

import pytest

from lorasp_jax.report.html import write_report
from lorasp_jax.training import records
from lorasp_jax.training.run_folder import RECORD, read_json, write_json
from tests.runs import RESULTS, finish


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        *[(1, int), (1, float), (1.5, float), (-1e38, float), (False, bool), ("x", str)],
        *[([], [float]), ([1, 2.5], [float]), ([1, 2], (float, float)), ({}, {}), ({"a": 1}, {})],
        *[({"a": 1, "b": None}, {"a": int}), ({"x": {"y": [0]}}, {str: {str: [int]}})],
    ],
)
def test_what_is_right(value, kind):
    records.check(value, kind)


@pytest.mark.parametrize(
    ("value", "kind", "sentence"),
    [
        (True, int, "x must be a whole number, not True"),
        (1.5, int, "x must be a whole number, not 1.5"),
        (10**39, int, "x must be a whole number, not 1000"),
        (False, float, "x must be a number, not False"),
        (float("nan"), float, "x must be a number, not nan"),
        (float("inf"), float, "x must be a number, not inf"),
        ("1", float, "x must be a number, not '1'"),
        (1, bool, "x must be a flag, not 1"),
        (None, str, "x must be a text, not None"),
        ({}, [int], "x must be a list, not {}"),
        ([1], (int, int), "x must be a list of 2, not [1]"),
        ([1, "a"], [int], "x[1] must be a whole number, not 'a'"),
        ([], {}, "x must be an object, not []"),
        ({"a": {}}, {"a": {"b": int}}, "x.a lacks 'b'"),
        ({"a": {"c": 0.5}}, {str: {str: int}}, "x.a.c must be a whole number, not 0.5"),
    ],
)
def test_what_is_wrong_is_named(value, kind, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        records.check(value, kind, "x")


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("tasks", {"press": {"success": 0.5}}, "tasks.press lacks 'before'"),
        ("tasks", 5, "tasks must be an object, not 5"),
        ("seconds", {"train": "long"}, "seconds.train must be a number, not 'long'"),
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
    config = read_json(tmp_path / RECORD)
    write_json(tmp_path / RECORD, config | {"peft": {"method": "LoRASP"} | peft})
    with pytest.raises(ValueError, match=rf"config\.json is damaged \({re.escape(sentence)}"):
        write_report(tmp_path)
