"""Killed and stopped processes; runs resumed on other devices."""

import contextlib
import json
import os
import random
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest

from lorasp_jax.adapters import adaptation
from lorasp_jax.training.checkpoint import COMMIT_MARKER
from lorasp_jax.training.distributed import processes
from lorasp_jax.training.run_folder import read_metrics
from tests import ROOT
from tests.runs import leaves, repeatable
from tests.several import environments
from tests.training.worker import work

STEPS = 8


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An uninterrupted run on one device."""
    return work(tmp_path_factory.mktemp("runs") / "whole", STEPS, devices=1)


@contextlib.contextmanager
def start_worker(folder, environment=None, **options):
    """Start a worker; kill it at the end of the block."""
    command = [sys.executable, "-u", "-m", "tests.training.worker", str(folder)]
    for name, value in options.items():
        command += [f"--{name}", str(value)]
    environment = os.environ | (environment or {})
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=ROOT, env=environment, stdout=pipe, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def wait_for(process, prefix):
    """Return the first printed line that starts with `prefix`."""
    for line in process.stdout:
        if line.startswith(prefix):
            return line
    pytest.fail(f"the process ended with {process.wait()} and never printed {prefix!r}")


def saved_digest(folder, step):
    """Return the digest of the state saved at a step."""
    return json.loads((folder / f"checkpoints/{step}/meta/metadata").read_text())["digest"]


def kill(folder, steps, rng):
    """Start or resume, then kill -9 during startup, restoring, training or saving."""
    # A fast machine could otherwise finish before the kill.
    with start_worker(folder, steps=steps, mesh=1, hangs=STEPS - 1) as process:
        wait_for(process, "started")
        for _ in range(rng.choice((0, 3, 4, 5))):
            wait_for(process, "step")
        time.sleep(rng.uniform(0, 0.1))


def test_a_run_that_died_while_saving_resumes_exactly(whole, tmp_path, capsys):
    """In this process: an error at step 5 leaves what a kill leaves."""
    died = tmp_path / "died"
    with pytest.raises(RuntimeError, match="nobody catches this"):
        work(died, STEPS, fails=5, devices=1)
    shutil.rmtree(died / "checkpoints/5", ignore_errors=True)
    (died / "checkpoints/4" / COMMIT_MARKER).unlink()
    with (died / "metrics.jsonl").open("a") as file:
        file.write('{"step": 5, "lo')
    capsys.readouterr()
    work(died, STEPS, devices=1)
    assert "started\nstep 4\n" in capsys.readouterr().out
    assert saved_digest(died, STEPS) == saved_digest(whole.folder, STEPS)
    assert repeatable(died) == repeatable(whole.folder)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_killed_run_resumes_exactly(tmp_path, capsys):
    steps, rng = 20 * STEPS, random.Random(0)
    expected = work(tmp_path / "whole", steps, devices=1).folder
    killed = tmp_path / "killed"
    for _ in range(20):
        kill(killed, steps, rng)
    newest = max(int(path.parent.name) for path in killed.glob(f"checkpoints/*/{COMMIT_MARKER}"))
    assert newest < steps  # otherwise nothing is left to train
    capsys.readouterr()
    work(killed, steps, devices=1)
    assert f"started\nstep {newest + 1}\n" in capsys.readouterr().out
    assert saved_digest(killed, steps) == saved_digest(expected, steps)
    assert repeatable(killed) == repeatable(expected)


def test_a_signal_to_another_process_also_stops_this_one(tmp_path, monkeypatch):
    answers = iter([False, True])  # at steps 1 and 2
    monkeypatch.setattr(processes, "any_process", lambda _: next(answers))
    assert work(tmp_path / "run", 6, devices=1) is None
    assert sorted(os.listdir(tmp_path / "run/checkpoints")) == ["1", "2"]


def adapters(run):
    return leaves(adaptation.split(run.policy.model)[1])


def assert_same(found, expected):
    """Compare up to rounding: other devices sum over a batch in another order."""
    for name, value in expected.items():
        np.testing.assert_allclose(
            found[name], value, atol=1e-5 * np.abs(value).max(), err_msg=name
        )


def test_a_run_resumes_on_another_number_of_devices(whole, tmp_path):
    moved = tmp_path / "moved"
    for count, until in ((4, 4), (1, None)):
        run = work(moved, STEPS, until, devices=count)
    assert_same(adapters(run), adapters(whole))


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_signal_to_one_of_two_processes_saves_on_both(whole, tmp_path):
    """Two processes with 2 devices each; then one process with 8 resumes."""
    folder = tmp_path / "run"
    one, other = environments(2)
    options = {"steps": STEPS, "devices": 2}
    with (
        start_worker(folder, one, **options) as first,
        start_worker(folder, other, until=3, **options) as second,
    ):
        for process in (first, second):
            wait_for(process, "stopped")
            assert process.wait(180) == 0
    stopped_at = max(int(path.name) for path in (folder / "checkpoints").iterdir())
    assert [row["step"] for row in read_metrics(folder)] == list(range(1, stopped_at + 1))
    assert 3 <= stopped_at < STEPS
    assert_same(adapters(work(folder, STEPS)), adapters(whole))
