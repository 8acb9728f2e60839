"""Which actions a robot executes when chunks arrive late, told by a policy that numbers them."""

import dataclasses
from dataclasses import field

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.evaluation.programs import make_rollout
from lorasp_jax.extras.latency.execution import (
    EXECUTIONS,
    Execution,
    Trace,
    check_delay,
    delayed_rollout,
)
from lorasp_jax.extras.latency.smoothness import action_delta, jerk
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import Method
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.statistics import Statistics
from lorasp_jax.policies.tokenizer import Offline
from tests.evaluation.test_programs import ROOMS, Room, compilations, policy

CHUNK, STEPS = 10, 4
CONFIG = dataclasses.replace(Pi0Config.dummy(), chunk=CHUNK)


@dataclasses.dataclass(frozen=True, eq=False)
class Clock(Room):
    """A room in which the second joint angle is the number of control steps taken."""

    def reset(self, key, ranges=None):
        state = super().reset(key, ranges)
        return dataclasses.replace(state, data=state.data.replace(qpos=jnp.zeros((16, 7))))

    def step(self, state, action):
        after = super().step(state, 0 * action)
        return dataclasses.replace(
            after, data=state.data.replace(qpos=state.data.qpos.at[:, 1].add(1))
        )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Numbering:
    """Samples chunks whose actions name the step of their observation, their index in the chunk,
    and what they continue: step and index of the first given action, how many, and β."""

    weight: jax.Array
    methods: tuple[Method, ...] = field(default=(), metadata={"static": True})
    config: Pi0Config = field(default=CONFIG, metadata={"static": True})

    def sampler(self):
        return self

    def sample_actions(
        self, key, obs, *, num_steps, slots, return_aux, prefix=None, prefix_length=-1, guidance=-1
    ):
        each = jnp.ones((len(obs.state), CHUNK))
        given = jnp.full((len(obs.state), 2), -1.0) if prefix is None else prefix[:, 0, :2]
        beta = -1 if guidance is None else guidance
        named = (obs.state[:, 1:2], jnp.arange(CHUNK), given[:, :1], given[:, 1:])
        columns = [each * value for value in (*named, prefix_length, beta, 0, 0)]
        return jnp.stack(columns, axis=-1), {}


ENV = Clock(("wait", "walk", "go"), 26)


@pytest.fixture(scope="module")
def numbering():
    identity = {"mean": np.zeros(7), "std": np.ones(7)}
    statistics = Statistics(identity, identity)
    prompts = PromptTable.of(Offline(), ENV.instructions, CONFIG, num_joints=6)
    return Policy(Numbering(jnp.ones(1)), Processor.of(CONFIG, statistics, prompts, num_joints=6))


def executed(numbering, execution, delay):
    """Return the commands of one world as integers, one row per control step."""
    rollout = delayed_rollout(ENV, Execution(execution, STEPS, 7.0), denoise_steps=2)
    trace = rollout(numbering, jax.random.key(0), delay)
    assert (trace.commands == trace.commands[:1]).all()
    assert (trace.steps >= ENV.max_steps).all()
    return np.rint(trace.commands[0, : ENV.max_steps]).astype(int)


@pytest.mark.parametrize("delay", [0, 1, 4])
@pytest.mark.parametrize("execution", ["naive", "trained", "guided"])
def test_the_robot_goes_on_with_the_previous_chunk_until_the_new_one_arrives(
    numbering, execution, delay
):
    for step, (observed, index, *_) in enumerate(executed(numbering, execution, delay)):
        since = step % STEPS
        late = since < delay and step >= STEPS
        assert observed == step - since - (STEPS if late else 0)
        assert index == step - observed


def test_the_robot_waits_in_synchronous_execution(numbering):
    """It observes, holds its last action for three steps, then executes four."""
    rows = executed(numbering, "synchronous", 3)
    first = [(0, i) for i in range(4)]
    second = [(0, 3)] * 3 + [(4, i) for i in range(4)]
    third = [(4, 3)] * 3 + [(11, i) for i in range(4)]
    assert rows[:18, :2].tolist() == [list(row) for row in first + second + third]


@pytest.mark.parametrize(
    ("execution", "expected"),
    [
        ("synchronous", [-1, -1, -1, -1]),
        ("naive", [-1, -1, -1, -1]),
        ("trained", [0, STEPS, 3, -1]),
        ("guided", [0, STEPS, 3, 7]),
    ],
)
def test_what_a_chunk_continues(numbering, execution, expected):
    """The first chunk continues nothing, the second the actions that remain of the first."""
    rows = executed(numbering, execution, 3)
    assert rows[:STEPS, 2:6].tolist() == [[-1] * 4] * STEPS
    second = next(row for row in rows if row[0] == STEPS)
    assert second[2:6].tolist() == expected


@pytest.mark.parametrize("execution", ["synchronous", "naive"])
def test_without_delay_it_is_the_ordinary_rollout(execution):
    key, steps = jax.random.key(3), {"execute_steps": 3, "denoise_steps": 2}
    for room in ROOMS:
        expected = make_rollout(room, **steps)(policy(), key)
        found = delayed_rollout(room, Execution(execution, 3), denoise_steps=2)(policy(), key, 0)
        np.testing.assert_array_equal(found.success, expected.success)
        np.testing.assert_array_equal(found.steps, expected.steps)
        assert 0 < found.success.sum() < 16


def test_one_compilation_gives_the_whole_curve(numbering):
    env = dataclasses.replace(ENV)
    with compilations() as counts:
        for execution in EXECUTIONS:
            rollout = delayed_rollout(env, Execution(execution, STEPS), denoise_steps=3)
            for delay in range(STEPS + 1):
                rollout(numbering, jax.random.key(0), delay)
    assert counts.pop("predict") == 3  # plain, trained, guided
    assert counts == {"_reset": 1, "_observe": 1, "_act": 1, "_hold": 1}


def test_delays_that_do_not_fit_are_refused(numbering):
    for delay, steps, longest in ((5, 4, 4), (-1, 4, 4), (4, 7, 3), (1, 10, 0)):
        text = f"of which {steps} are executed, the delay must be from 0 to {longest} .* {delay}$"
        with pytest.raises(ValueError, match=text):
            check_delay(delay, steps, CHUNK)
    rollout = delayed_rollout(ENV, Execution("naive", STEPS), denoise_steps=2)
    with pytest.raises(ValueError, match="with chunks of 10 actions"):
        rollout(numbering, jax.random.key(0), 5)


def test_smoothness_of_executed_joint_targets():
    """A cubic has a constant third difference; the gripper and steps after the end do not count."""
    t = np.arange(9.0)
    commands = np.zeros((2, 9, 3))
    commands[0, :, 0], commands[0, :, 2] = t**3, 100 * t**2
    commands[1, :, :2] = np.stack([3 * t, 4 * t], axis=1)
    commands[1, 6:] = 1e6
    trace = Trace(np.ones(2, bool), np.array([9, 6]), commands)
    cubes, line = np.diff(t**3), np.full(5, 5.0)
    np.testing.assert_allclose(action_delta(trace), np.concatenate([cubes, line]).mean())
    np.testing.assert_allclose(jerk(trace, 0.1), np.mean([6.0] * 6 + [0.0] * 3) / 1e-3)
    ended = dataclasses.replace(trace, steps=np.array([1, 1]))
    assert action_delta(ended) == jerk(ended, 0.1) == 0
