import dataclasses

import pytest

from lorasp_jax.extras.study import runner, status
from lorasp_jax.extras.study.status import Board, State
from lorasp_jax.peft import LoRA
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
    found = Board(study(), folder).read()
    assert {name: status.state for name, status in found.items()} == {
        "sp/s0": State.RUNNABLE,
        "sp/s1": State.RUNNABLE,
        "lora/s0": State.WAITING,
        "lora/s1": State.WAITING,
        "lr": State.RUNNABLE,
        "cut/s0": State.WAITING,
    }
    assert found["lora/s0"].reason == "for sp/s0 (runnable), sp/s1 (runnable)"
    assert found["sp/s1"].config.name == "s1"
    assert found["lora/s0"].config is None


def test_configs_that_depend_on_missing_results_are_guessed(folder):
    found = Board(study(), folder).read()
    guess = found["lora/s1"].guess
    assert guess == dataclasses.replace(CONFIG, name="s1", peft=LoRA(rank=1), seed=1)
    assert found["cut/s0"].guess == found["lora/s0"].guess
    assert found["sp/s0"].guess is None
    broken = study(**{"lora/s0": lambda results: results["lr"]})
    found = Board(broken, folder).read()
    assert found["lora/s0"].guess is None
    assert found["cut/s0"].guess is None


def test_only_changes_are_read_again(folder, monkeypatch):
    finish(folder, ["sp/s0", "sp/s1", "lora/s0", "lr"])
    board = Board(study(), folder)
    first = board.read()
    read, read_json = [], status.read_json
    monkeypatch.setattr(
        status, "read_json", lambda path, schema: read.append(path) or read_json(path, schema)
    )
    assert [*map(id, board.read().values())] == [*map(id, first.values())]
    assert read == []
    finish(folder, ["cut/s0"])
    read.clear()
    assert board.read()["cut/s0"].state is State.FINISHED
    assert read == [folder / "cut/s0/cell.json"]
    (folder / "sp/s1/cell.json").unlink()
    found = board.read()
    assert (found["sp/s1"].state, found["lora/s1"].state) == (State.RUNNABLE, State.WAITING)
    assert found["lr"] is first["lr"]


def test_a_damaged_result_is_named(folder):
    finish(folder)
    file = folder / "sp/s0/cell.json"
    file.write_text(file.read_text().replace("123", "124"))
    found = Board(study(), folder).read()
    assert found["sp/s0"].state is State.DAMAGED
    assert str(file) in found["sp/s0"].reason
    assert found["lora/s0"].state is State.FINISHED
    assert found["lr"].state is State.FINISHED


@pytest.mark.parametrize("content", ["", "{", "[]", '{"digest": ""}'])
def test_a_damaged_config_is_named(folder, content):
    begin(folder / "sp/s0", CONFIG)
    (folder / "sp/s0/config.json").write_text(content)
    assert states(folder)["sp/s0"] == State.DAMAGED


def test_changed_settings_are_named(folder):
    finish(folder)
    found = Board(other(seed=5, log_every=7), folder).read()["sp/s0"]
    assert (found.state, found.reason) == (State.CHANGED, "it was run with other log_every, seed")


def test_changed_settings_of_an_unfinished_cell_are_named(folder):
    begin(folder / "sp/s0", dataclasses.replace(CONFIG, name="s0"))
    assert states(folder)["sp/s0"] == State.RUNNABLE
    assert states(folder, other(seed=5))["sp/s0"] == State.CHANGED


def test_results_that_change_a_config_are_noticed(folder):
    finish(folder)
    for name in ("sp/s0", "sp/s1"):
        (folder / name / "cell.json").unlink()
    assert states(folder)["lora/s0"] == State.FINISHED
    assert states(folder)["cut/s0"] == State.FINISHED

    def higher(job):
        return {**fakes.run(job), "active_rank": {"mean": 7.0}}

    runner.work(study(), folder, NAMES, higher)
    found = Board(study(), folder).read()
    assert (found["lora/s0"].state, found["lora/s0"].reason) == (
        State.CHANGED,
        "it was run with other peft.rank",
    )


def test_a_config_that_cannot_be_made_fails_the_cell(folder):
    finish(folder, ["sp/s0", "sp/s1"])
    broken = study(**{"lora/s0": lambda results: results["lr"]})
    found = Board(broken, folder).read()
    assert found["lora/s0"].state is State.FAILED
    assert found["lora/s0"].reason == "its config cannot be made: KeyError: 'lr'"
    assert found["lora/s1"].state is State.RUNNABLE


def test_a_finished_cell_is_tidied(folder):
    for name in ("checkpoints", "tensorboard"):
        (folder / "lr" / name / "1").mkdir(parents=True)
    finish(folder)
    assert [path.name for path in (folder / "lr").iterdir()] == ["cell.json"]


def test_a_failure_is_kept_until_cleared(folder):
    status.record_failure(folder / "lr", "out of memory", "details")
    (folder / "lr" / ".failed.txt.0a1b.tmp").touch()
    assert Board(study(), folder).read()["lr"].reason == "out of memory"
    status.clear_failure(folder / "lr")
    assert states(folder)["lr"] == State.RUNNABLE
    assert list((folder / "lr").iterdir()) == []
