"""Demonstrations are collected once, then read from the run's cache."""

import dataclasses
import threading

import numpy as np
import pytest

import envs
from lorasp_jax.training.demonstrations import demonstrations, fresh_demonstrations, map_threads
from tests.runs import CONFIG, random_episodes


def test_collected_once(tmp_path, monkeypatch):
    calls = []

    def collect(task, **settings):
        calls.append((task, settings["robot"], settings["num_episodes"], settings["control_dt"]))
        settings["progress"](3, 3)
        assert settings["ranges"] is None
        return random_episodes(task, len(task))

    monkeypatch.setattr(envs, "collect", collect)
    reports = []
    first = demonstrations(CONFIG, tmp_path, lambda *now: reports.append(now))
    assert sorted(calls) == [("pick_place", "piper", 512, 0.1), ("press", "piper", 512, 0.1)]
    assert sorted(reports) == [("pick_place", 3, 3), ("press", 3, 3)]
    second = demonstrations(CONFIG, tmp_path, lambda *now: None)
    assert len(calls) == 2
    assert list(first) == list(second) == ["press", "pick_place"]
    for task, episodes in second.items():
        assert episodes.task == task
        np.testing.assert_array_equal(episodes.action, first[task].action)


def test_fresh_ones_are_randomized_too(tmp_path, monkeypatch):
    drawn = []

    def collect(task, **settings):
        drawn.append(settings["ranges"])
        return random_episodes(task, 0)

    monkeypatch.setattr(envs, "collect", collect)
    ranges = envs.Randomization(table_height=(0.0, 0.02))
    config = dataclasses.replace(CONFIG, tasks=("press",), scene=ranges)
    demonstrations(config, tmp_path, lambda *now: None)
    fresh_demonstrations(config, 1)
    assert drawn == [ranges, ranges]


def test_a_cache_with_another_control_period_is_rejected(tmp_path):
    random_episodes("press", 0).save(tmp_path / "cache" / "press.npz")
    config = dataclasses.replace(CONFIG, tasks=("press",), control_dt=0.2)
    with pytest.raises(ValueError, match=r"0\.2"):
        demonstrations(config, tmp_path, lambda *now: None)


def test_map_threads_keeps_order_and_does_not_wait_after_an_error():
    barrier = threading.Barrier(2, timeout=60)

    def meet(number):
        barrier.wait()  # passes only if both run at the same time
        return number

    assert map_threads(meet, [1, 2]) == [1, 2]
    release = threading.Event()

    def fail_or_hang(number):
        if number == 0:
            raise ValueError("first")
        release.wait(20)

    with pytest.raises(ValueError, match="first"):
        map_threads(fail_or_hang, [0, 1])
    release.set()
