"""The policy in the loop: one jit, on every platform; what it reports."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from lorasp_jax.evaluation import evaluate, make_rollout
from lorasp_jax.evaluation.rollout import _ranks, _told
from lorasp_jax.peft import Aux, LoRASP
from tests.runs import CONFIG, make_run


@pytest.fixture(scope="module")
def env():
    return envs.make("press", robot="piper", num_envs=2, image_size=32)


def policy_with(folder, **fields):
    config = dataclasses.replace(CONFIG, peft=LoRASP(rank=8, hidden_width=8, **fields))
    return make_run(folder, config).policy


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
@pytest.mark.parametrize(
    ("platform", "kind", "gate"),
    [
        ("cpu", "cpu", "bisection"),
        ("cuda", "NVIDIA H200", "pallas"),
        ("tpu", "TPU v5e", "bisection"),
    ],
)
def test_lowers_for(platform, kind, gate, env, tmp_path):
    policy = _told(policy_with(tmp_path / "run", gate=gate), env)
    device = jax.sharding.AbstractDevice(device_kind=kind, num_cores=None, platform=platform)
    mesh = jax.sharding.AbstractMesh((), (), abstract_device=device)
    shapes = jax.eval_shape(lambda: (policy, jax.random.key(0)))
    with jax.sharding.use_abstract_mesh(mesh):
        traced = jax.jit(make_rollout(env, execute_steps=4, denoise_steps=2)).trace(*shapes)
        text = traced.lower(lowering_platforms=(platform,)).as_text()
    assert ("__gpu$xla.gpu.triton" in text) == (gate == "pallas")


def test_evaluate_reports_what_happened(env, tmp_path):
    policy = policy_with(tmp_path / "run")
    rollout = jax.jit(make_rollout(env, execute_steps=4, denoise_steps=1))
    seen = []
    result = evaluate(
        policy,
        env,
        jax.random.key(0),
        4,
        rollout=rollout,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen == [(2, 4), (4, 4)]
    assert result.episodes == 4
    assert result.ci95[0] <= result.success <= result.ci95[1]
    assert 0 < result.steps <= env.max_steps
    assert set(result.active_rank) == {"vision", "language", "action"}
    assert len(result.active_rank["action"]["q_proj"]) == 2  # layers
    assert len(result.active_rank["vision"]["patch_embed"]) == 1
    ranks = [r for maps in result.active_rank.values() for layers in maps.values() for r in layers]
    assert min(ranks) >= 1
    assert max(ranks) <= 8 + 1e-5  # a weighted mean in fp32
    assert result.poses[0].shape[0] <= env.max_steps
    again = evaluate(policy, env, jax.random.key(0), 4, rollout=rollout)
    assert (again.success, again.steps) == (result.success, result.steps)
    with pytest.raises(ValueError, match="3 episodes are not a positive multiple of the 2 worlds"):
        evaluate(policy, env, jax.random.key(0), 3, rollout=rollout)


def test_ranks_leave_out_padding_and_finished_worlds():
    rank = jnp.arange(2 * 3 * 4, dtype=jnp.float32).reshape(2, 3, 4)  # [L, W, T]
    mask = jnp.ones((2, 3, 4), bool).at[:, 1, 2:].set(False)
    running = jnp.array([False, True, False])
    steps = jnp.stack([rank, rank + 10])  # [denoising steps, L, W, T]
    aux = {
        "vision": {"fc1": Aux(rank, token_mask=mask)},
        "action": {"fc1": Aux(steps, token_mask=jnp.stack([mask, mask])), "none": Aux()},
    }
    found = _ranks(aux, running)
    np.testing.assert_allclose(found["vision"]["fc1"], [4.5, 16.5])
    np.testing.assert_allclose(found["action"]["fc1"], [9.5, 21.5])
    assert "none" not in found["action"]
