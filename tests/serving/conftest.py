"""A fake arm on which the client's loop runs."""

import pytest

from lorasp_jax.serving.fake_piper.world import World
from lorasp_jax.serving.piper.safety import Limits
from tests.serving.benches import Bench


@pytest.fixture(scope="module")
def world():
    return World("press", image_size=16)


@pytest.fixture
def bench(world):
    bench = Bench(world).ready(Limits.of())
    yield bench
    bench.close()
