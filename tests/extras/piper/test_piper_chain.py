"""The scripted expert solves all tasks through client, piper_sdk, CAN bus and fake arm."""

import pytest

from envs.names import names
from lorasp_jax.extras.piper.asking import InTurn
from lorasp_jax.extras.piper.fake.demonstrator import Demonstrator
from lorasp_jax.extras.piper.fake.world import World
from lorasp_jax.extras.piper.session import Session
from lorasp_jax.extras.piper.settings import Settings
from tests.extras.piper.benches import Bench

EPISODES = 8


@pytest.mark.slow
@pytest.mark.parametrize("task", names("task"))
@pytest.mark.parametrize("latency", [0.0, 0.1])
def test_the_expert_solves_every_task(task, latency):
    world = World(task)
    bench, problems, wins = Bench(world, latency=latency).ready(), [], 0
    for seed in range(EPISODES):
        bench.clock.reset(seed)
        bench.wait(0.3)
        asker = InTurn(Demonstrator(world, bench.clock, seed), bench.clock)
        settings = Settings(world.instruction)
        parts = (bench.arms, world.images, asker, settings, bench.clock)
        session = Session(*parts, say=problems.append)
        session.run(world.env.task.time_limit, bench.every_control_step(world.judge))
        wins += world.success
    assert problems == []
    assert bench.fake.unsafe == []
    assert wins >= EPISODES - 1
    bench.close()
