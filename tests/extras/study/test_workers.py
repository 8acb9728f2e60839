import dataclasses

import pytest

from lorasp_jax.extras.study import results, workers
from lorasp_jax.extras.study.progress import clear_failure
from tests.extras.study import fakes
from tests.extras.study.fakes import NAMES, ran, states


@pytest.fixture
def start(capfd):
    def start(folder, run_cell, count=1, load=fakes.study):
        workers.run_workers(load, folder, [cell.name for cell in load().cells], count, run_cell)
        return capfd.readouterr().out

    return start


@pytest.fixture
def folder(tmp_path):
    return tmp_path


def test_a_worker_that_dies_fails_its_cell_and_is_replaced(folder, start):
    text = start(folder, fakes.run_or_die)
    assert ran(folder) == ["sp/s0"]
    assert states(folder) == {
        "sp/s0": "finished",
        "sp/s1": "failed",
        "lora/s0": "waiting",
        "lora/s1": "waiting",
        "lr": "failed",
        "cut/s0": "waiting",
    }
    assert "sp/s1: failed: the worker stopped by SIGKILL" in text
    assert "lr: failed: RuntimeError: boom bang" in text
    assert "sp/s0: press 37.5%, pour 37.5% in 3 s" in text


@pytest.mark.slow
def test_two_workers_die_in_one_cell(folder, start):
    start(folder, fakes.run_beside_another)
    assert states(folder) == {**dict.fromkeys(NAMES, "finished"), "lr": "failed"}


@pytest.mark.slow
def test_a_worker_that_dies_between_cells_ends_the_study(folder, start):
    with pytest.raises(ValueError, match="a worker stopped by SIGKILL outside of a cell"):
        start(folder, fakes.run_and_die_late)
    assert set(states(folder).values()) == {"finished"}


@pytest.mark.slow
def test_two_workers_share_the_cells(folder, start):
    text = start(folder, fakes.run_slowly, count=2)
    assert sorted(ran(folder)) == sorted(NAMES)
    assert set(states(folder).values()) == {"finished"}
    assert text.count("running ") == 6
    assert {path.stem for path in (folder / "logs").rglob("*.txt")} >= {"s0", "s1", "lr"}


@pytest.mark.slow
def test_one_of_four_workers_is_killed(folder, start):
    text = start(folder, fakes.run_with_three_others, count=4, load=fakes.many)
    names = [cell.name for cell in fakes.many().cells]
    assert sorted(ran(folder)) == sorted({*names} - {"c2"})
    assert states(folder, fakes.many()) == {**dict.fromkeys(names, "finished"), "c2": "failed"}
    assert "c2: failed: the worker stopped by SIGKILL" in text
    assert text.count(" s\n") == 11
    clear_failure(folder / "c2")
    start(folder, fakes.run, count=4, load=fakes.many)
    assert sorted(ran(folder)) == sorted(names)


@pytest.mark.slow
def test_interrupted_workers_stop(folder, start):
    with pytest.raises(KeyboardInterrupt):
        start(folder, fakes.run_and_interrupt)
    assert states(folder)["sp/s0"] == "runnable"


@pytest.mark.slow
def test_workers_that_cannot_start(folder):
    with pytest.raises(ValueError, match="a worker stopped with exit code 1 outside of a cell"):
        workers.run_workers(fakes.no_study, folder, NAMES, 1, fakes.run)


def test_a_small_study_runs_here(folder):
    lines = []
    found = workers.run_here(fakes.study(), folder, ["sp/s0", "lr"], lines.append, fakes.run)
    assert sorted(found) == ["lr", "sp/s0"] == sorted(ran(folder))
    assert results.load(folder / "results.json") == found
    assert [line for line in lines if line.startswith("running")] == ["running sp/s0", "running lr"]
    again = workers.run_here(fakes.study(), folder, ["lr"], lines.append, fakes.run)
    assert (again, len(ran(folder))) == (found, 2)
    with pytest.raises(ValueError, match="lora/s0: waiting for sp/s1"):
        workers.run_here(fakes.study(), folder, ["lora/s0"], lines.append, fakes.run)
    assert results.load(folder / "results.json") == found
    fewer = dataclasses.replace(fakes.study(), cells=(fakes.study()["lr"],))
    workers.run_here(fewer, folder, ["lr"], lines.append, fakes.run)
    assert results.load(folder / "results.json") == found, "results of other cells stay"
