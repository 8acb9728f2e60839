import json

import pytest

from lorasp_jax.extras.study import results, runner
from tests.extras.study import fakes


@pytest.fixture
def found(tmp_path):
    runner.work(fakes.study(), tmp_path, fakes.NAMES, fakes.run)
    return fakes.results(tmp_path)


def test_the_file_depends_only_on_the_results(tmp_path, found):
    files = [tmp_path / "a.json", tmp_path / "b.json"]
    results.write(files[0], "fake", found)
    results.write(files[1], "fake", dict(reversed(found.items())))
    assert files[0].read_bytes() == files[1].read_bytes()
    results.write(files[1], "fake", results.load(files[0]))
    assert files[0].read_bytes() == files[1].read_bytes()
    content = json.loads(files[0].read_text())
    assert list(content) == sorted(content)
    assert content["cells"]["sp/s1"]["config"].keys() >= {"name", "seed"}
    assert "optim.steps" in content["common"].keys() & content["cells"]["lr"]["config"].keys()
    assert "optim.steps" not in content["cells"]["sp/s1"]["config"]


def test_no_results(tmp_path):
    results.write(tmp_path / "a.json", "fake", {})
    assert results.load(tmp_path / "a.json") == {}


def test_a_damaged_file_is_refused(tmp_path, found):
    path = tmp_path / "a.json"
    results.write(path, "fake", found)
    path.write_text(path.read_text().replace("123.456", "123.457"))
    with pytest.raises(ValueError, match=r"a\.json.*digest does not match"):
        results.load(path)


def test_results_are_read_as_written(tmp_path, found):
    """With settings of all kinds."""
    found["lr"]["config"]["peft"] = {"method": "X", "empty": {}, "none": None, "list": [1, "a.b"]}
    results.write(tmp_path / "a.json", "fake", found)
    assert results.load(tmp_path / "a.json") == found
