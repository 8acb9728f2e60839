"""Rollouts: what happens in them, and that their programs are compiled only once."""

import contextlib
import dataclasses
import functools
from dataclasses import field
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from jax import monitoring

from envs.scene.ranges import Randomization
from envs.state import Data, State
from lorasp_jax import models
from lorasp_jax.adapters import adaptation
from lorasp_jax.config import EvaluationConfig
from lorasp_jax.evaluation import programs
from lorasp_jax.evaluation.programs import compiled_rollout, make_rollout
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import Aux, FullFineTuning, LoRA, LoRAMoE, LoRASP, Method
from lorasp_jax.policies import statistics_files
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.statistics import Statistics
from lorasp_jax.policies.tokenizer import Offline
from lorasp_jax.training.demonstrations import map_threads
from lorasp_jax.training.distributed import mesh as meshes
from tests import ROOT
from tests.runs import CONFIG

KEY = jax.random.key(3)
POLICY = {"_sampler": 1, "predict": 1}
WORLD = ("_reset", "_observe", "_act")


@contextlib.contextmanager
def compilations():
    """Count the programs of an evaluation that are compiled in this block, by name."""
    counts = {}

    def listen(event, duration, fun_name="", **_):
        name = fun_name.removeprefix("jit(").removesuffix(")")
        if event == "/jax/core/compile/backend_compile_duration" and name in {
            *POLICY,
            *WORLD,
            "_hold",
            "correct_action",
        }:
            counts[name] = counts.get(name, 0) + 1

    monitoring.register_event_duration_secs_listener(listen)
    try:
        yield counts
    finally:
        monitoring.unregister_event_duration_listener(listen)


@dataclasses.dataclass(frozen=True, eq=False)
class Room:
    """An environment without physics: a world succeeds when its first joint angle exceeds 1."""

    instructions: tuple[str, ...]
    max_steps: int
    num_envs: int = 16

    def reset(self, key, ranges=None):
        zero = jnp.zeros(self.num_envs)
        pose = jnp.zeros((self.num_envs, 2, 3))
        info = {
            "success": zero > 0,
            "steps": zero.astype(jnp.int32),
            "instruction": jax.random.randint(key, (self.num_envs,), 0, len(self.instructions)),
            "draw": None if ranges is None else zero + ranges.turn[0],
        }
        state = jax.random.normal(key, (self.num_envs, 7))
        state = state if ranges is None else state + ranges.turn[0]
        data = Data(**{f.name: pose for f in dataclasses.fields(Data)})
        return State(data.replace(qpos=state), zero, zero > 0, {}, info)

    def observe(self, state):
        image = jnp.full((self.num_envs, 32, 32, 3), 100, jnp.uint8)
        return {"image": {"side": image, "wrist": image}, "state": state.data.qpos}

    def step(self, state, action):
        qpos = state.data.qpos + 0.1 * action
        success = state.info["success"] | (qpos[:, 0] > 1)
        steps = state.info["steps"] + ~success
        info = state.info | {"success": success, "steps": steps}
        data = state.data.replace(qpos=qpos)
        return State(data, state.reward, success | (steps >= self.max_steps), {}, info)


ROOMS = Room(("open it", "close it"), 6), Room(("wait", "walk", "go"), 9)
TABLE = PromptTable.of(
    Offline(), [t for room in ROOMS for t in room.instructions], Pi0Config.dummy(), num_joints=6
)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Model:
    """A random policy whose actions and active rank depend on the prompt."""

    weight: jax.Array
    methods: tuple[Method, ...] = field(metadata={"static": True})
    config: Pi0Config = field(default=Pi0Config.dummy(), metadata={"static": True})

    def sampler(self):
        return self

    def sample_actions(self, key, obs, *, num_steps, slots, return_aux):
        assert return_aux
        noise = jax.random.normal(key, (len(obs.state), self.config.chunk, slots.size))
        prompt = jnp.sum(obs.tokens * obs.token_mask, 1) % 5
        actions = noise * self.weight[0] / num_steps + prompt[:, None, None] - 2
        rank = prompt[None, :, None].astype(jnp.float32)
        return jnp.where(slots, actions, 0), {"vision": {"fc1": Aux(rank, token_mask=rank >= 0)}}


def policy(weight=0.5, method=CONFIG.peft, devices=1):
    """A policy placed as in training, sharded over the devices."""
    data = np.random.default_rng(0).normal(size=(9, 7))
    statistics = Statistics.measure(data, data, np.ones(9, bool), slots=range(7), dim=8)
    processor = Processor.of(Pi0Config.dummy(), statistics, TABLE, num_joints=6)
    mesh = meshes.make_mesh(devices, jax.devices()[:devices])
    weights = jnp.full((len(data), 8), weight)
    weights = jax.device_put(weights, meshes.shardings(weights, mesh, minimum=0))
    return Policy(Model(weights, (method,)), processor)


def step_by_step(room, policy, key, ranges=None):
    """Run the same episodes in Python: the last state, unfinished worlds and ranks per call."""
    reset_key, sample_key = jax.random.split(key)
    observe, step = jax.jit(room.observe), jax.jit(room.step)
    sample = jax.jit(functools.partial(Policy.sample, num_steps=2, return_aux=True))
    state, running, ranks = jax.jit(room.reset)(reset_key, ranges), [], []
    rows = policy.processor.prompts.rows(room.instructions)[state.info["instruction"]]
    for call in range(room.max_steps // 3):
        call_key, observation = jax.random.fold_in(sample_key, call), observe(state)
        actions, aux = sample(policy, call_key, observation, jnp.asarray(rows))
        running.append(int((~state.done).sum()))
        ranks.append(aux["vision"]["fc1"].active_rank[0, ~state.done].mean(0))
        for action in actions[:, :3].swapaxes(0, 1):
            state = step(state, action)
    return state, running, ranks


@pytest.mark.parametrize(
    ("method", "rank"),
    [
        (LoRA(rank=5), 5),
        (FullFineTuning(), 0),
        (LoRAMoE(experts=3, rank=2), 6),
        (LoRAMoE(experts=3, rank=2, routing="top1"), 2),
    ],
)
def test_max_rank(method, rank):
    assert programs._max_rank(policy(method=method)) == rank


@pytest.mark.parametrize(
    ("room", "ranges"), [(ROOMS[0], None), (ROOMS[1], Randomization(turn=(0.5, 0.5)))]
)
def test_the_policy_acts_in_the_worlds(room, ranges):
    found = make_rollout(room, execute_steps=3, denoise_steps=2, ranges=ranges)(policy(), KEY)
    state, running, ranks = step_by_step(room, policy(), KEY, ranges)
    for name in ("success", "steps"):
        np.testing.assert_array_equal(getattr(found, name), state.info[name], name)
    assert found.running.tolist() == running
    np.testing.assert_allclose(found.active_rank["vision"]["fc1"], ranks, rtol=1e-5)
    assert found.active_rank_histogram["vision"].sum(-1).tolist() == running
    assert set(np.unique(found.success)) == {False, True}
    assert found.running[0] == 16 > found.running[-1]


def test_randomized_rollouts():
    """The ranges reach the environment; other ranges need no other programs."""
    room, found = dataclasses.replace(ROOMS[0]), []
    for index, shift in enumerate((0.5, 0.25)):
        ranges = Randomization(turn=(shift, shift))
        with compilations() as counts:
            found.append(make_rollout(room, execute_steps=3, ranges=ranges)(policy(), KEY))
        assert bool(counts) == (index == 0)
        assert found[-1].draw.tolist() == 8 * [shift]
    plain = make_rollout(room, execute_steps=3)(policy(), KEY)
    assert plain.draw is None
    assert len({tuple(r.steps.tolist()) for r in (plain, *found)}) > 1


def test_the_config_says_whether_to_randomize(monkeypatch):
    monkeypatch.setattr(programs, "environment", lambda *_: ROOMS[0])
    ranges = Randomization(turn=(0.5, 0.5))
    plain = dataclasses.replace(CONFIG, evaluation=EvaluationConfig(execute_steps=3))
    for config, draw in ((plain, None), (dataclasses.replace(plain, scene=ranges), 0.5)):
        _, rollout = compiled_rollout(SimpleNamespace(config=config), "press")
        found = rollout(policy(), jax.random.key(0)).draw
        assert found is None if draw is None else set(found.tolist()) == {draw}


@pytest.mark.parametrize("devices", [1, 2])
def test_tasks_share_the_policy_and_methods_the_tasks(devices):
    rooms = [dataclasses.replace(room) for room in ROOMS]
    rollouts = [make_rollout(room, execute_steps=3, denoise_steps=1) for room in rooms]

    def run(policy):
        with compilations() as counts:
            policy = policy.with_sampler()
            map_threads(lambda rollout: rollout(policy, KEY), rollouts)
        return counts

    one, other = LoRA(rank=2), LoRA(rank=3)
    assert run(policy(0.5, one, devices)) == POLICY | dict.fromkeys(WORLD, 2)
    assert run(policy(0.25, one, devices)) == {}
    assert run(policy(0.25, other, devices)) == POLICY


@pytest.mark.slow
def test_tasks_share_programs_in_simulation():
    """The base on its own robot, with tasks of different lengths and instructions."""
    settings = EvaluationConfig(episodes=8, num_envs=8, denoise_steps=4)
    config = dataclasses.replace(CONFIG, robot="panda", image_size=64, evaluation=settings)
    run = SimpleNamespace(config=config)
    folder = ROOT / "assets" / "pi0_nano"
    model = models.load(folder)
    rules = [("q_proj", LoRASP(rank=8, hidden_width=8))]
    model = adaptation.adapt(model, rules, rngs=nnx.Rngs(0))
    key = jax.random.key(5)
    with compilations() as counts:
        pairs = [compiled_rollout(run, task) for task in ("press", "open_pot")]
        texts = [text for env, _ in pairs for text in env.instructions]
        prompts = PromptTable.of(Offline(), texts, model.config, num_joints=7)
        statistics = statistics_files.read(folder)
        base = Policy(model, Processor.of(model.config, statistics, prompts, num_joints=7))
        policy = base.with_sampler()
        rollouts = map_threads(lambda rollout: rollout(policy, key), [r for _, r in pairs])
        pairs[0][1](base, jax.random.key(6))
    assert counts == POLICY | dict.fromkeys(WORLD, 2)
    assert compiled_rollout(run, "press")[0] is pairs[0][0]
    assert rollouts[0].success.any()
