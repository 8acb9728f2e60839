"""Demonstrations that are replaced during training."""

import dataclasses

import jax
import numpy as np
import pytest

from lorasp_jax.data.batches import fit_to_size, flatten, windows
from lorasp_jax.peft import LoRA
from lorasp_jax.training import batches, demonstrations
from lorasp_jax.training.loop import train
from tests.runs import (
    CONFIG,
    PROGRAMS,
    Miniature,
    Terminate,
    make_run,
    random_episodes,
    repeatable,
)

SAME = dataclasses.replace(CONFIG, peft=LoRA(rank=4), targets=("inp", "out"))
FRESH = dataclasses.replace(SAME, data=dataclasses.replace(SAME.data, fresh_every=2))


class Collect:
    """Records the requested generations, without simulation."""

    def __init__(self):
        self.generations = []

    def __call__(self, config, generation):
        self.generations.append(generation)
        return {task: random_episodes(task, 10 * generation) for task in config.tasks}


def run(folder, config=FRESH):
    run = make_run(folder, config, Miniature())
    run.programs = PROGRAMS
    return run


def test_generations_replace_each_other(tmp_path, monkeypatch):
    """The first one is as without replacement; a resumed run reproduces all of them exactly."""
    collect = Collect()
    monkeypatch.setattr(batches, "fresh_demonstrations", collect)
    same, whole = run(tmp_path / "same", SAME), run(tmp_path / "whole")
    train(same)
    assert collect.generations == []
    train(whole)
    assert collect.generations == [*range(1, CONFIG.optim.steps // 2)]
    first, *others = zip(repeatable(same.folder), repeatable(whole.folder), strict=True)
    assert first[0] == first[1]
    assert all(without != fresh for without, fresh in others)
    halved = run(tmp_path / "halved")
    with pytest.raises(KeyboardInterrupt):
        train(halved, [Terminate()])
    collect.generations.clear()
    halved = run(tmp_path / "halved")
    train(halved, [Terminate()], resume=True)
    assert collect.generations == [*range(1, CONFIG.optim.steps // 2)]
    assert repeatable(halved.folder) == repeatable(whole.folder)
    collect.generations.clear()
    # As after a stop during the final evaluation.
    train(run(tmp_path / "whole"), resume=True)
    assert collect.generations == []


@pytest.mark.parametrize("size", [13, 21, 50])
def test_of_size(size):
    """Windows stay within their episode, even if it is truncated or repeated."""
    steps = flatten([random_episodes("press", 0)])  # 5, 9 and 7 steps
    found = fit_to_size(steps, size)
    start = np.arange(size)
    window, inside = windows(found, start, 4)
    assert len(found.end) == size
    assert window.max() == size - 1
    expected, _ = windows(steps, start % 21, 4)
    np.testing.assert_array_equal(found.action[window][inside], steps.action[expected][inside])
    if size == 21:
        np.testing.assert_array_equal(found.end, steps.end)


def test_each_generation_has_its_own_keys(monkeypatch):
    monkeypatch.setattr(demonstrations.envs, "collect", lambda _, key, **others: key)
    keys = [demonstrations.fresh_demonstrations(CONFIG, number) for number in (1, 1, 2)]
    data = [jax.random.key_data(found[CONFIG.tasks[0]]).tolist() for found in keys]
    assert data[0] == data[1] != data[2]


def test_what_does_not_go_together():
    with pytest.raises(ValueError, match="fresh_every cannot be combined with"):
        dataclasses.replace(FRESH.data, source="somewhere")
    with pytest.raises(ValueError, match="multiple of log_every, got 3 and 2"):
        dataclasses.replace(FRESH, data=dataclasses.replace(FRESH.data, fresh_every=3))
