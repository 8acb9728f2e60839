import io

import pytest
from rich.console import Console

from lorasp_jax.extras.study import results, workers
from lorasp_jax.extras.study.progress import clear_failure
from tests.extras.study import fakes
from tests.extras.study.fakes import NAMES, ran, states


def start(folder, run_cell, count=1, load=fakes.study):
    console = Console(file=io.StringIO(), width=200)
    names = [cell.name for cell in load().cells]
    workers.Workers(load, folder, names, console, run_cell).run(count)
    return console.file.getvalue()


@pytest.fixture
def folder(tmp_path):
    return tmp_path


def test_a_worker_that_dies_fails_its_cell_and_is_replaced(folder):
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
    assert "sp/s1: failed the worker stopped by SIGKILL" in text
    assert "lr: failed RuntimeError: boom bang" in text
    assert "sp/s0: press 37.5%, pour 37.5% in 3 s" in text


@pytest.mark.slow
def test_two_workers_share_the_cells(folder):
    text = start(folder, fakes.run_slowly, count=2)
    assert sorted(ran(folder)) == sorted(NAMES)
    assert set(states(folder).values()) == {"finished"}
    assert "6/6" in text
    assert {path.stem for path in (folder / "logs").rglob("*.txt")} >= {"s0", "s1", "lr"}


@pytest.mark.slow
def test_one_of_four_workers_is_killed(folder):
    text = start(folder, fakes.run_with_three_others, count=4, load=fakes.many)
    names = [cell.name for cell in fakes.many().cells]
    assert sorted(ran(folder)) == sorted({*names} - {"c2"})
    assert states(folder, fakes.many()) == {**dict.fromkeys(names, "finished"), "c2": "failed"}
    assert "c2: failed the worker stopped by SIGKILL" in text
    assert "11/12" in text
    clear_failure(folder / "c2")
    start(folder, fakes.run, count=4, load=fakes.many)
    assert sorted(ran(folder)) == sorted(names)


@pytest.mark.slow
def test_interrupted_workers_stop(folder):
    with pytest.raises(KeyboardInterrupt):
        start(folder, fakes.run_and_interrupt)
    assert states(folder)["sp/s0"] == "runnable"


@pytest.mark.slow
def test_workers_that_cannot_start(folder):
    console = Console(file=io.StringIO())
    pool = workers.Workers(fakes.study, folder, NAMES, console, fakes.run)
    pool._arguments = (fakes.no_study, *pool._arguments[1:])
    with pytest.raises(ValueError, match="a worker stopped with exit code 1 outside of a cell"):
        pool.run(1)


def test_a_small_study_runs_here(folder):
    console = Console(file=io.StringIO())
    found = workers.run_here(fakes.study(), folder, ["sp/s0", "lr"], console, fakes.run)
    assert sorted(found) == ["lr", "sp/s0"] == sorted(ran(folder))
    assert results.load(folder / "results.json") == found
    assert console.file.getvalue().split() == ["measuring", "sp/s0", "measuring", "lr"]
    again = workers.run_here(fakes.study(), folder, ["lr"], console, fakes.run)
    assert (again, len(ran(folder))) == (found, 2)
    with pytest.raises(ValueError, match="lora/s0: waiting for sp/s1"):
        workers.run_here(fakes.study(), folder, ["lora/s0"], console, fakes.run)
