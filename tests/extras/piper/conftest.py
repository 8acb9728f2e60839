"""A fake arm on which the client's loop runs."""

import numpy as np
import pytest

from lorasp_jax.extras.piper import session as sessions
from lorasp_jax.extras.piper.fake.world import World
from lorasp_jax.extras.piper.safety import Limits
from tests.extras.piper.benches import Bench


@pytest.fixture(scope="session")
def world():
    """A scene whose programs are compiled once; each bench resets it."""
    return World("press", image_size=16)


@pytest.fixture
def bench(world):
    bench = Bench(world).ready(Limits.of())
    yield bench
    bench.close()


@pytest.fixture
def near_rest(bench, monkeypatch):
    """Let the rest pose be near, so that the way to it is short."""
    monkeypatch.setattr(sessions, "REST", bench.world.pose + 0.1 * np.eye(7)[0])
