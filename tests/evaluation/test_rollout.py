"""Closed-loop rollouts in simulation, and lowering of the policy for every platform."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

import envs
from lorasp_jax.evaluation import evaluate, make_rollout
from lorasp_jax.evaluation.programs import predict
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.tokenizer import Offline
from tests.jaxprs import target
from tests.runs import CONFIG, make_run


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
@pytest.mark.parametrize(
    ("platform", "kind", "gate"),
    [
        pytest.param("cpu", "cpu", "pairwise", marks=pytest.mark.slow),
        ("cuda", "NVIDIA H200", "pallas"),
        pytest.param("tpu", "TPU v5e", "bisection", marks=pytest.mark.slow),
    ],
)
def test_lowers_for(platform, kind, gate, tmp_path):
    policy = make_run(tmp_path / "run", dataclasses.replace(CONFIG, targets=("q_proj",))).policy
    images = {name: np.zeros((2, 32, 32, 3), np.uint8) for name in ("side", "wrist")}
    observation = {"image": images, "state": np.zeros((2, 7), np.float32)}
    rows, done = np.zeros(2, np.int32), np.zeros(2, bool)
    inputs = jax.random.key(0), np.int32(0), observation, rows, done
    shapes = jax.eval_shape(lambda: (policy.with_sampler(), *inputs))
    with target(platform, kind):
        traced = jax.jit(functools.partial(predict, denoise_steps=2)).trace(*shapes)
        text = traced.lower(lowering_platforms=(platform,)).as_text()
    assert ("__gpu$xla.gpu.triton" in text) == (gate == "pallas")


@pytest.mark.slow
def test_evaluate(tmp_path):
    env = envs.make("press", robot="piper", num_envs=2, image_size=32)
    policy = make_run(tmp_path / "run").policy
    prompts = PromptTable.of(Offline(), env.instructions, policy.model.config, num_joints=6)
    policy = Policy(policy.model, dataclasses.replace(policy.processor, prompts=prompts))
    rollout = make_rollout(env, execute_steps=4, denoise_steps=1)
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
