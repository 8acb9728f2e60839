"""The command: trains on the run's own demonstrations, and says what it lacks."""

import dataclasses

import pytest

from lorasp_jax.config import DataConfig
from lorasp_jax.data import cache
from lorasp_jax.data.opening import open_source
from lorasp_jax.training.correction import __main__ as command
from lorasp_jax.training.correction import files, fitting, run
from lorasp_jax.training.run_folder import to_json
from tests.evaluation.test_programs import policy
from tests.runs import CONFIG, finish, random_episodes


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A finished run on two tasks, with a stand-in for the policy."""
    (tmp_path / "run").mkdir()
    folder = finish(tmp_path / "run")
    (folder / "cache").mkdir()
    for seed, task in enumerate(CONFIG.tasks):
        random_episodes(task, seed).save(folder / "cache" / f"{task}.npz")
    monkeypatch.setattr(run, "load_policy", lambda run: policy())
    for name in ("STEPS", "HELD_OUT_BATCHES"):
        monkeypatch.setattr(fitting, name, 1)
    return folder


def refused(capsys, folder):
    """Return the line on stderr of a command that fails."""
    assert command.main([str(folder)]) == 2
    printed = capsys.readouterr().err
    assert printed.count("error:") == 1
    assert not (folder / files.DESCRIPTION).exists()
    return printed


def test_a_head_is_trained_and_saved(folder, capsys):
    assert command.main([str(folder)]) == 0
    error = files.describe(folder)["error"]
    text = f"{error['naive']:.3f} without the correction head, {error['corrected']:.3f} with it"
    assert text in capsys.readouterr().out
    assert files.load(folder, policy()).cameras == ("side", "wrist")


def test_the_demonstrations_of_all_tasks(folder):
    steps = run.demonstrated(folder, to_json(CONFIG))
    assert len(steps.end) == 42
    assert sorted(set(steps.instruction.tolist())) == [0, 1, 2, 3]


def test_a_dataset_is_a_cache_or_has_one_in_the_run(folder, tmp_path):
    file, mine = folder / "cache" / "press.npz", tmp_path / "mine"
    cache.write([open_source(file)], mine, lambda *_: None)
    config = to_json(dataclasses.replace(CONFIG, data=DataConfig(source=str(mine))))
    assert len(run.demonstrated(folder, config).end) == 21
    mine.rename(folder / "cache" / "steps")
    assert len(run.demonstrated(folder, config).end) == 21


def test_what_is_missing_is_named(folder, capsys, monkeypatch):
    (folder / "cache" / "press.npz").unlink()
    line = refused(capsys, folder)
    assert "press.npz is missing: a correction head needs the demonstrations" in " ".join(
        line.split()
    )
    monkeypatch.undo()
    assert "contains no policy: no run has finished there" in " ".join(
        refused(capsys, folder).split()
    )
