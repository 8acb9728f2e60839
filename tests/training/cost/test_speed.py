"""Logged throughput, data wait and memory use."""

from types import SimpleNamespace

import jax
import pytest

from lorasp_jax.training.cost import flops, speed
from lorasp_jax.training.cost.speed import Speed


@pytest.fixture
def clock(monkeypatch):
    """A clock that the test advances."""
    now = SimpleNamespace(seconds=100.0)
    monkeypatch.setattr(speed.time, "perf_counter", lambda: now.seconds)
    return now


def device(**memory):
    return [SimpleNamespace(device_kind="NVIDIA H100 80GB HBM3", memory_stats=lambda: memory)]


def test_log_intervals(clock, monkeypatch):
    monkeypatch.setattr(jax, "devices", device)
    monkeypatch.setattr(jax, "device_count", lambda: 2)
    peak = flops.PEAK["NVIDIA H100"]
    timer = Speed(batch_size=8, step_flops=0.5 * peak)
    for interval in range(2):
        clock.seconds += 7 * interval  # between two intervals
        timer.begin()
        clock.seconds += 5
        timer.begin()  # the next step of the same interval
        clock.seconds += 5
        found = timer.end(20)
        assert found["speed/samples_per_second"] == 20 * 8 / 10
        assert found["speed/flop_utilisation"] == pytest.approx(20 * 0.5 / 2 / 10)
        assert "speed/data_wait" not in found


def test_waiting_counts_only_if_the_device_is_idle(clock):
    timer = Speed(batch_size=8, step_flops=None)
    for times in range(2):
        timer.begin()
        for ready in (False, True, False):
            with timer.waiting(SimpleNamespace(is_ready=lambda ready=ready: ready)):
                clock.seconds += 2
        found = timer.end(3)
        assert found["speed/data_wait"] == pytest.approx(2 / 6), times
        assert "speed/flop_utilisation" not in found


def test_memory_if_the_device_reports_it(monkeypatch):
    assert speed.memory() == {}  # a CPU
    memory = device(bytes_in_use=2**30, peak_bytes_in_use=3 * 2**29, num_allocs=4)
    monkeypatch.setattr(jax, "local_devices", lambda: memory)
    assert speed.memory() == {"memory/in_use_gib": 1.0, "memory/peak_gib": 1.5}
    monkeypatch.setattr(jax, "local_devices", device)
    assert speed.memory() == {}
