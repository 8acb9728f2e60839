"""A fake arm on which the client's loop runs."""

import pytest

from lorasp_jax.extras.piper.fake.world import World
from lorasp_jax.extras.piper.safety import Limits
from tests.extras.piper.benches import Bench


@pytest.fixture(scope="module")
def world():
    return World("press", image_size=16)


@pytest.fixture
def bench(world):
    bench = Bench(world).ready(Limits.of())
    yield bench
    bench.close()
