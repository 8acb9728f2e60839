import contextlib
import dataclasses
import multiprocessing
import random
import threading

import pytest

from lorasp_jax.extras.study import progress, results, runner
from lorasp_jax.extras.study.progress import CellState, clear_failure
from lorasp_jax.extras.study.study import Derived
from tests.extras.study import fakes
from tests.extras.study.fakes import NAMES, ran, run, states, study


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "POLL", 0.01)
    (tmp_path / "fake").mkdir()
    return tmp_path / "fake"


def work(folder, names=NAMES, run_cell=run, of=None):
    runner.work(of or study(), folder, names, run_cell)


def work_together(count, *arguments):
    """Work in threads."""
    threads = [threading.Thread(target=work, args=arguments) for _ in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def test_cells_run_once_in_order(folder):
    work(folder)
    assert ran(folder) == ["sp/s0", "sp/s1", "lora/s0", "lora/s1", "cut/s0", "lr"]
    work(folder)
    assert len(ran(folder)) == 6
    assert set(states(folder).values()) == {CellState.FINISHED}


def test_configs_and_transformations_get_the_results_they_name(folder):
    work(folder)
    found = fakes.results(folder)
    ranks = [found[name]["active_rank"]["mean"] for name in ("sp/s0", "sp/s1")]
    assert found["lora/s1"]["config"]["peft"]["rank"] == round(sum(ranks) / 2)
    assert found["lora/s1"]["config"]["name"] == "s1"
    assert found["cut/s0"]["measures"]["needs"] == ["lora/s0", "sp/s0"]
    assert found["cut/s0"]["config"]["source"] == "lora/s0"


def test_a_failed_cell_does_not_stop_the_others(folder):
    def fail(job):
        if job.cell.name == "sp/s1":
            raise RuntimeError("boom\nbang")
        return run(job)

    work(folder, run_cell=fail)
    assert ran(folder) == ["sp/s0", "lr"]
    statuses = progress.read(study(), folder)
    assert (statuses["sp/s1"].state, statuses["sp/s1"].reason) == (
        CellState.FAILED,
        "RuntimeError: boom bang",
    )
    assert statuses["cut/s0"].reason == "for lora/s0 (waiting)"
    assert 'raise RuntimeError("boom' in (folder / "sp/s1" / "failed.txt").read_text()
    work(folder)
    assert ran(folder) == ["sp/s0", "lr"]
    clear_failure(folder / "sp/s1")
    work(folder)
    assert sorted(ran(folder)) == sorted(NAMES)


def test_several_workers_run_every_cell_once(folder):
    work_together(4, folder, NAMES, fakes.run_slowly)
    assert sorted(ran(folder)) == sorted(NAMES)
    assert set(states(folder).values()) == {CellState.FINISHED}


def test_workers_share_a_group_when_no_other_is_left(folder):
    both = threading.Barrier(2, timeout=60)

    def meet(job):
        result = run(job)
        if job.cell.name.startswith("sp/"):
            both.wait()  # afterwards, as a worker could go on before the other has noted its run
        return result

    work_together(2, folder, NAMES, meet)
    assert {*ran(folder)[:3]} == {"sp/s0", "sp/s1", "lr"}
    assert set(states(folder).values()) == {CellState.FINISHED}


def test_each_worker_begins_with_a_group_of_its_own(folder):
    names = [f"{group}/{i}" for group in "abc" for i in range(3)]
    cells = [dataclasses.replace(study()["lr"], name=name, group=name[0]) for name in names]
    barrier, first = threading.Barrier(3, timeout=60), {}

    def meet(job):
        if threading.get_ident() not in first:
            first[threading.get_ident()] = job.cell.name
            barrier.wait()
        return run(job)

    work_together(3, folder, names, meet, dataclasses.replace(study(), cells=tuple(cells)))
    assert sorted(ran(folder)) == names
    assert sorted(first.values()) == ["a/0", "b/0", "c/0"]


def test_a_worker_goes_on_with_the_group_that_it_has_compiled(folder):
    first = dataclasses.replace(study(), cells=(study()["lr"], *study().cells[:4]))
    second = dataclasses.replace(study()["lr"], name="lr2", group="lr")
    names = ["lr", "sp/s0", "sp/s1", "lr2"]
    mixed = dataclasses.replace(first, cells=(*first.cells[:3], second))
    work(folder, names, of=mixed)
    assert ran(folder) == ["lr", "lr2", "sp/s0", "sp/s1"]


def test_workers_run_a_missing_source_once(folder, tmp_path):
    work(folder)
    finished = fakes.results(folder)
    for name in ("cut/s0", "cut/s1"):
        finished.pop(name, None)
    empty = tmp_path / "empty"
    empty.mkdir()
    second = Derived("cut/again", "lora/s0", study()["cut/s0"].transform, ("sp/s0",))
    started = dataclasses.replace(study(), cells=(*study().cells, second), finished=finished)
    names = ["cut/s0", "cut/again"]
    work_together(3, empty, names, fakes.run_slowly, started)
    assert sorted(ran(empty)) == ["cut/again", "cut/s0", "lora/s0"]


@contextlib.contextmanager
def _taken_at_first(claimed, folder, name, seen):
    """Claim a cell, unless it is the first time that the source is asked for."""
    if name == "lora/s0" and not seen:
        seen.append(name)
        yield False
        return
    with claimed(folder, name) as own:
        yield own


def test_a_source_that_is_released_in_between_does_not_change_the_order(
    folder, tmp_path, monkeypatch
):
    work(folder)
    finished = fakes.results(folder)
    finished.pop("cut/s0")
    empty, claimed, seen = tmp_path / "empty", runner._claimed, []
    empty.mkdir()
    monkeypatch.setattr(runner, "_claimed", lambda *at: _taken_at_first(claimed, *at, seen))
    second = Derived("cut/again", "lora/s0", study()["cut/s0"].transform, ("sp/s0",))
    started = dataclasses.replace(study(), cells=(*study().cells, second), finished=finished)
    work(empty, ["cut/s0", "cut/again"], of=started)
    assert ran(empty) == ["lora/s0", "cut/s0", "cut/again"]


def test_kills_do_not_change_the_results(folder, tmp_path):
    undisturbed = tmp_path / "undisturbed"
    undisturbed.mkdir()
    work(undisturbed)
    context, delays = multiprocessing.get_context("forkserver"), random.Random(0)
    context.set_forkserver_preload(["tests.extras.study.fakes", "lorasp_jax.extras.study.runner"])
    for _ in range(8):
        process = context.Process(target=work, args=(folder, NAMES, fakes.run_slowly))
        process.start()
        process.join(delays.uniform(0.01, 0.3))
        process.kill()
        process.join()
    work(folder)
    files = []
    for each in (undisturbed, folder):
        results.write(each / "results.json", "fake", fakes.results(each))
        files.append((each / "results.json").read_bytes())
    assert files[0] == files[1]
