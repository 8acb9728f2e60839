"""A fake arm on which the client's loop runs."""

import numpy as np
import pytest

from envs.rendering.video import write_video
from lorasp_jax.extras.piper import remote, safety
from lorasp_jax.extras.piper.arms import Arms
from lorasp_jax.extras.piper.fake.hand_over import HandOver
from lorasp_jax.extras.piper.fake.world import World
from tests.extras.piper.benches import Bench
from tests.extras.piper.piper_runs import Still
from tests.extras.serving.stand_in import serving


@pytest.fixture(scope="session")
def world():
    """A scene whose programs are compiled once; each bench resets it."""
    return World("press", image_size=16)


@pytest.fixture
def bench(world):
    bench = Bench(world).ready()
    yield bench
    bench.close()


@pytest.fixture(scope="session")
def table():
    """A scene with two arms, as `world` is one with one."""
    return HandOver(image_size=16)


@pytest.fixture
def pair(table):
    bench = Bench(table).ready()
    yield bench
    bench.close()


@pytest.fixture
def near_rest(bench, monkeypatch):
    """Let the rest pose be near, so that the way to it is short."""
    rest = bench.world.pose + 0.1 * np.eye(7)[0]
    monkeypatch.setattr(Arms, "rest", property(lambda _: rest))


@pytest.fixture
def patient(monkeypatch):
    """Tolerate that a busy machine pauses the arm's thread."""
    monkeypatch.setattr(safety, "MAX_AGE", 60.0)
    monkeypatch.setattr(safety, "MAX_DRIVER_AGE", 60.0)


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setattr(remote, "_WAIT", 0.0)
    policy = Still()
    with serving(policy) as server:
        server.policy = policy
        yield server


@pytest.fixture
def film(tmp_path):
    write_video(tmp_path / "film.mp4", np.zeros((5, 32, 32, 3), np.uint8), 30)
    return str(tmp_path / "film.mp4")
