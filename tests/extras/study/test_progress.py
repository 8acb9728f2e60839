import dataclasses

import pytest

from lorasp_jax.extras.study import progress, runner
from lorasp_jax.extras.study.progress import CellState
from tests.extras.study import fakes
from tests.extras.study.fakes import CONFIG, NAMES, begin, states, study


@pytest.fixture
def folder(tmp_path):
    return tmp_path


def finish(folder, names=NAMES):
    runner.work(study(), folder, names, fakes.run)


def other(**changes):
    return study(**{"sp/s0": dataclasses.replace(CONFIG, **changes)})


def test_nothing_has_run(folder):
    found = progress.read(study(), folder)
    assert {name: status.state for name, status in found.items()} == {
        "sp/s0": CellState.RUNNABLE,
        "sp/s1": CellState.RUNNABLE,
        "lora/s0": CellState.WAITING,
        "lora/s1": CellState.WAITING,
        "lr": CellState.RUNNABLE,
        "cut/s0": CellState.WAITING,
    }
    assert found["lora/s0"].reason == "for sp/s0 (runnable), sp/s1 (runnable)"
    assert found["sp/s1"].config.name == "s1"
    assert found["lora/s0"].config is None


@pytest.mark.parametrize("content", ["", "{", "[]", '{"digest": ""}'])
def test_a_damaged_config_is_named(folder, content):
    begin(folder / "sp/s0", CONFIG)
    (folder / "sp/s0/config.json").write_text(content)
    assert states(folder)["sp/s0"] == CellState.DAMAGED


def test_changed_settings_of_an_unfinished_cell_are_named(folder):
    begin(folder / "sp/s0", dataclasses.replace(CONFIG, name="s0"))
    assert states(folder)["sp/s0"] == CellState.RUNNABLE
    assert states(folder, other(seed=5))["sp/s0"] == CellState.CHANGED


def test_results_that_change_a_config_are_noticed(folder):
    finish(folder)
    for name in ("sp/s0", "sp/s1"):
        (folder / name / "cell.json").unlink()
    assert states(folder)["lora/s0"] == CellState.FINISHED
    assert states(folder)["cut/s0"] == CellState.FINISHED

    def higher(job):
        return {**fakes.run(job), "active_rank": {"mean": 7.0}}

    runner.work(study(), folder, NAMES, higher)
    found = progress.read(study(), folder)
    assert (found["lora/s0"].state, found["lora/s0"].reason) == (
        CellState.CHANGED,
        "it was run with other peft.rank",
    )


def test_a_config_that_cannot_be_made_fails_the_cell(folder):
    finish(folder, ["sp/s0", "sp/s1"])
    broken = study(**{"lora/s0": lambda results: results["lr"]})
    found = progress.read(broken, folder)
    assert found["lora/s0"].state is CellState.FAILED
    assert found["lora/s0"].reason == "its config cannot be made: KeyError: 'lr'"
    assert found["lora/s1"].state is CellState.RUNNABLE


def test_a_finished_cell_is_tidied(folder):
    for name in ("checkpoints", "tensorboard"):
        (folder / "lr" / name / "1").mkdir(parents=True)
    finish(folder)
    assert [path.name for path in (folder / "lr").iterdir()] == ["cell.json"]


def test_a_failure_is_kept_until_cleared(folder):
    progress.record_failure(folder / "lr", "out of memory", "details")
    (folder / "lr" / ".failed.txt.0a1b.tmp").touch()
    assert progress.read(study(), folder)["lr"].reason == "out of memory"
    progress.clear_failure(folder / "lr")
    assert states(folder)["lr"] == CellState.RUNNABLE
    assert list((folder / "lr").iterdir()) == []
