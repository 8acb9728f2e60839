"""Closed-loop rollouts: lowering for every platform, and their results."""

import dataclasses

import jax
import numpy as np
import pytest

import envs
from lorasp_jax.evaluation import evaluate, make_rollout
from lorasp_jax.evaluation.rollout import _max_rank
from lorasp_jax.peft import FullFineTuning, LoRA, LoRASP
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.tokenizer import Offline
from tests.runs import CONFIG, make_run


@pytest.fixture(scope="module")
def env():
    return envs.make("press", robot="piper", num_envs=2, image_size=32)


def policy_with(folder, env, targets=CONFIG.targets, **fields):
    peft = LoRASP(rank=8, hidden_width=8, **fields)
    config = dataclasses.replace(CONFIG, peft=peft, targets=targets)
    policy = make_run(folder, config).policy
    prompts = PromptTable.of(Offline(), env.instructions, policy.model.config, num_joints=6)
    return Policy(policy.model, dataclasses.replace(policy.processor, prompts=prompts))


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
@pytest.mark.parametrize(
    ("platform", "kind", "gate"),
    [
        pytest.param("cpu", "cpu", "bisection", marks=pytest.mark.slow),
        ("cuda", "NVIDIA H200", "pallas"),
        pytest.param("tpu", "TPU v5e", "bisection", marks=pytest.mark.slow),
    ],
)
def test_lowers_for(platform, kind, gate, env, tmp_path):
    policy = policy_with(tmp_path / "run", env, ("q_proj",))
    device = jax.sharding.AbstractDevice(device_kind=kind, num_cores=None, platform=platform)
    mesh = jax.sharding.AbstractMesh((), (), abstract_device=device)
    shapes = jax.eval_shape(lambda: (policy, jax.random.key(0)))
    with jax.sharding.use_abstract_mesh(mesh):
        traced = jax.jit(make_rollout(env, execute_steps=4, denoise_steps=2)).trace(*shapes)
        text = traced.lower(lowering_platforms=(platform,)).as_text()
    assert ("__gpu$xla.gpu.triton" in text) == (gate == "pallas")


@pytest.mark.slow
def test_evaluate(env, tmp_path):
    policy = policy_with(tmp_path / "run", env)
    rollout = jax.jit(make_rollout(env, execute_steps=4, denoise_steps=1))
    reported = []
    result = evaluate(
        policy,
        env,
        jax.random.key(0),
        4,
        rollout=rollout,
        progress=lambda done, total: reported.append((done, total)),
    )
    assert reported == [(2, 4), (4, 4)]
    assert result.episodes == 4
    assert result.ci95[0] <= result.success <= result.ci95[1]
    assert 0 < result.steps <= env.max_steps
    assert set(result.active_rank) == {"vision", "language", "action"}
    assert len(result.active_rank["action"]["q_proj"]) == 2  # layers
    assert len(result.active_rank["vision"]["patch_embed"]) == 1
    ranks = [r for maps in result.active_rank.values() for layers in maps.values() for r in layers]
    assert min(ranks) >= 1
    assert max(ranks) <= 8 + 1e-5  # a weighted mean in fp32
    assert set(result.active_rank_histogram) == set(result.active_rank)
    for tower, counts in result.active_rank_histogram.items():
        assert (counts.shape, counts[0]) == ((9,), 0)
        used = np.flatnonzero(counts)
        means = np.concatenate(list(result.active_rank[tower].values()))
        assert used[0] - 1e-5 <= means.min() <= means.max() <= used[-1] + 1e-5
    assert result.poses[0].shape[0] <= env.max_steps
    again = evaluate(policy, env, jax.random.key(0), 4, rollout=rollout)
    assert (again.success, again.steps) == (result.success, result.steps)
    with pytest.raises(ValueError, match="num_episodes must be a positive multiple of 2, got 3"):
        evaluate(policy, env, jax.random.key(0), 3, rollout=rollout)


@pytest.mark.slow
def test_a_sampler_gives_the_same_rollout(env, tmp_path):
    policy = policy_with(tmp_path / "run", env)
    rollout = make_rollout(env, execute_steps=4, denoise_steps=1)
    trace = jax.make_jaxpr(rollout, return_shape=True)
    (one, shapes), (other, others) = (
        trace(p, jax.random.key(0)) for p in (policy, policy.with_sampler())
    )
    assert shapes == others
    assert shapes.active_rank_histogram["action"].shape[-1] == 9
    assert loop_body(one) == loop_body(other)  # the sampler is created before the loop
    assert len(one.eqns) > len(other.eqns)


def loop_body(jaxpr):
    """Return the body of a rollout's loop."""
    (body,) = (e.params["jaxpr"] for e in jaxpr.eqns if e.primitive.name == "scan")
    return str(body)


def test_max_rank(tmp_path):
    lora = make_run(tmp_path / "lora", dataclasses.replace(CONFIG, peft=LoRA(rank=5))).policy
    full = make_run(tmp_path / "full", dataclasses.replace(CONFIG, peft=FullFineTuning())).policy
    assert [_max_rank(policy.with_sampler()) for policy in (lora, full)] == [5, 0]
