"""Calls to Weights & Biases, recorded by a fake module."""

import contextlib
import sys
from types import SimpleNamespace

import pytest

from lorasp_jax.cli import train
from lorasp_jax.training.run_folder import write_json
from lorasp_jax.training.weights_and_biases import WeightsAndBiases
from tests.runs import CONFIG, RESULTS
from tests.test_train import MULTITASK


class Fake:
    """Fake of the used part of the package, which records all calls."""

    class Error(Exception):
        pass

    def __init__(self):
        self.inits, self.rows, self.codes, self.metrics = [], [], [], []

    def init(self, **options):
        if options["project"] == "refused":
            raise self.Error("not\nlogged in")
        self.inits.append(options)
        return SimpleNamespace(
            id=options["id"] or f"id {len(self.inits)}",
            log=self.rows.append,
            finish=lambda *, exit_code: self.codes.append(exit_code),
            define_metric=lambda name, step_metric: self.metrics.append((name, step_metric)),
        )

    def Video(self, path):
        return "video", path


@pytest.fixture
def fake(monkeypatch):
    module = Fake()
    monkeypatch.setitem(sys.modules, "wandb", module)
    return module


def test_a_run_and_its_resume(fake, tmp_path):
    folder = tmp_path / "test"
    folder.mkdir()
    run = SimpleNamespace(folder=folder, config=CONFIG)
    before = RESULTS["tasks"]["press"]["before"]
    write_json(folder / "before.json", {"press": before | {"success": 0.25}})
    with contextlib.suppress(KeyboardInterrupt), WeightsAndBiases("arms", CONFIG, folder) as first:
        assert list(folder.iterdir()) == [
            folder / "before.json"
        ]  # no id is recorded before the start
        first.on_start(run)
        first.on_log(run, 2, {"loss": 0.5})
        raise KeyboardInterrupt
    with WeightsAndBiases("arms", CONFIG, folder) as callback:
        callback.on_log(run, 2, {"loss": 0.4})
        write_json(folder / "results.json", RESULTS)
        callback.on_end(run)
    assert [(options["project"], options["id"], options["name"]) for options in fake.inits] == [
        ("arms", None, "test"),
        ("arms", "id 1", "test"),
    ]
    assert fake.inits[0]["config"]["peft"]["method"] == "LoRASP"
    assert fake.inits[0]["dir"] == str(tmp_path)
    assert fake.codes == [1, 0]
    assert fake.metrics == 2 * [("*", "step")]
    assert fake.rows == [
        {"step": 0, "success/press": 0.25},
        {"step": 2, "loss": 0.5},
        {"step": 2, "loss": 0.4},
        {"step": 4, "success/press": 0.75},
        {"step": 4, "rollout/press": ("video", str(folder / "rollout_press.mp4"))},
    ]


@pytest.mark.parametrize("project", ["arms", "refused"])
def test_errors_are_one_sentence(project, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "wandb", None if project == "arms" else Fake())
    assert train.main([*MULTITASK, "--wandb", project]) == 2
    printed = capsys.readouterr().err
    expected = {"arms": "needs the package wandb: pip install wandb", "refused": "not logged in"}
    assert expected[project] in printed
    assert printed.count("\n") == 1
    assert not [*tmp_path.rglob("*.json")]
