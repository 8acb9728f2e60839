"""Two fake arms hand over a stick, through the client, piper_sdk and two CAN buses."""

import mujoco
import numpy as np
import pytest

from lorasp_jax.extras.piper.asking import InTurn
from lorasp_jax.extras.piper.fake import hand_over
from lorasp_jax.extras.piper.fake.demonstrator import Demonstrator
from lorasp_jax.extras.piper.fake.hand_over import TASK, HandOver
from lorasp_jax.extras.piper.session import Session
from lorasp_jax.extras.piper.settings import Settings
from tests.extras.piper.benches import Bench

EPISODES = 4


def run(bench, each_step=lambda: None, problems=None):
    """Run the expert, and return the holders of the stick and its height at every step."""
    world, seen = bench.world, []
    asker = InTurn(Demonstrator(world, bench.clock, 0), bench.clock)
    say = pytest.fail if problems is None else problems.append
    parts = (bench.arms, world.images, asker, Settings(world.instruction), bench.clock)
    session = Session(*parts, say=say)

    def step():
        each_step()
        seen.append((world.holders(), world.height))
        return world.judge()

    session.run(TASK.time_limit, bench.every_control_step(step))
    return seen


def gap(world):
    """Return the distance between the arms [m], which do not collide in the simulation."""
    model, (left, right) = world.model, ("base", "right_base")
    roots = model.body_rootid[model.geom_bodyid]
    shape = model.geom_group < 3  # without the stand-ins for collisions
    one, other = (np.flatnonzero((roots == model.body(x).id) & shape) for x in (left, right))
    pairs = ((a, b) for a in one for b in other)
    return min(mujoco.mj_geomDistance(model, world.data, a, b, 1.0, None) for a, b in pairs)


@pytest.mark.slow
@pytest.mark.parametrize("latency", [0.0, 0.1])
def test_the_expert_hands_over(latency):
    world = HandOver(image_size=16)
    bench, wins, gaps = Bench(world, latency=latency).ready(), 0, []
    for seed in range(EPISODES):
        bench.clock.reset(seed)
        bench.wait(0.3)
        seen = run(bench, lambda: gaps.append(gap(world)))
        wins += world.success
        holders = [held for held, _ in seen]
        order = [x for x, before in zip(holders, [None, *holders], strict=False) if x != before]
        assert [x for x in order if len(x) == 1] == [{"left"}, {"right"}]
        assert seen[-1][1] > 0.26
    assert wins == EPISODES
    assert [fake.unsafe for fake in bench.fakes] == [[], []]
    assert min(gaps) > 0.005
    bench.close()


@pytest.mark.slow
def test_a_fault_while_both_hold_the_stick_holds_both():
    world, said = HandOver(image_size=16), []
    bench = Bench(world, seed=0).ready()

    def fail_once_both_hold():
        if world.holders() == {"left", "right"}:
            bench.fakes[0].faults.status = 7

    run(bench, fail_once_both_hold, said)
    assert said == ["holding: left arm: the arm reports status 7 (collision)"]
    assert not world.success
    bench.wait(1.0)
    assert world.holders() == {"left", "right"}
    bench.close()


def test_layouts_and_requests_follow_the_seed(table):
    poses = []
    for seed in (1, 2, 1):
        table.reset(seed)
        poses.append(table.data.joint("stick").qpos.copy())
        assert table.instruction in TASK.instructions
    np.testing.assert_array_equal(poses[0], poses[2])
    assert (poses[0] != poses[1]).any()


def test_the_right_arm_alone_does_not_hand_over(table, monkeypatch):
    """It must get the stick from the left arm."""
    monkeypatch.setattr(hand_over, "_RAISED", 0.1)
    table.reset(0)
    table.data.joint("stick").qpos[:] = [*table.data.site("right_tcp").xpos, 1, 0, 0, 0]
    for finger in ("right_left", "right_right"):
        table.data.joint(finger).qpos[:] = 0.0125
    right = table.limbs["right"]
    for _ in range(20):
        right.command(np.append(right.pose[:6], 0.0))
        table.advance(0.05)
        table.judge()
    assert table.holders() == {"right"}
    assert not table.success
    table._carried = True
    assert [table.judge() for _ in range(5)] == [False] * 4 + [True]


def test_what_carries_one_arm_does_not_carry_the_other(table):
    table.reset(0)
    before = [limb.pose for limb in table.limbs.values()]
    table.limbs["right"].support("none")
    table.advance(0.5)
    left, right = (limb.pose for limb in table.limbs.values())
    table.limbs["right"].support("motors")
    np.testing.assert_allclose(left, before[0], atol=0.01)
    assert np.abs(right - before[1])[:6].max() > 0.1
