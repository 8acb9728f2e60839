"""Cut policies equal the best approximation of each layer; pruned ones do not change."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.dense import AdapterParam, Dense
from lorasp_jax.extras.deployment import variants
from lorasp_jax.peft import AdaLoRA, LoRA
from lorasp_jax.policies.policy import Policy
from studies.paper import transforms
from studies.paper.measures import cost
from tests.adapters.test_adaptation import LAYERS, WIDTH, Net, call
from tests.runs import CONFIG, make_run
from tests.studies.paper.updates import add_noise, matrix

MATRICES = LAYERS + 3  # a stack, an input layer and two heads


def lora_policy(rank=3):
    model = lorasp_jax.adapt(Net(nnx.Rngs(0)), [(".*", LoRA(rank=rank))], rngs=nnx.Rngs(1))
    return Policy(add_noise(model), None)


def updates(policy):
    """Each layer's update in fp64, by path."""
    found = {}
    for location in paths.locate(nnx.List([policy.model]), Dense):
        method, params = location.child.method_and_params()
        a, b = (np.asarray(params[name], np.float64) for name in ("lora_a", "lora_b"))
        e = np.asarray(params.get("lora_e", np.ones(a.shape[-1])), np.float64)
        found[location.path] = method.scale * (a * e[..., None, :]) @ b
    return {path: u.reshape(-1, *u.shape[-2:]) for path, u in found.items()}


def best(update, rank):
    left, values, right = np.linalg.svd(update)
    return (left[:, :rank] * values[:rank]) @ right[:rank]


@pytest.mark.parametrize("mean_rank", [0.5, 1.34, 2.0])
def test_every_layer_gets_its_best_approximation_of_one_threshold(mean_rank):
    policy = lora_policy()
    before, after = updates(policy), updates(transforms.cut(policy, mean_rank))
    kept, dropped = [], []
    for path, stack in before.items():
        for full, small in zip(stack, after[path], strict=True):
            rank = np.linalg.matrix_rank(small, tol=1e-6)
            np.testing.assert_allclose(small, best(full, rank), atol=1e-6)
            values = np.linalg.svd(full, compute_uv=False)
            kept, dropped = [*kept, *values[:rank]], [*dropped, *values[rank:]]
    assert len(kept) == round(mean_rank * MATRICES)
    assert min(kept) > max(dropped)


def test_evaluation_sees_the_mean_rank():
    """Reported active ranks average to the target over layers, each layer of a stack alike."""
    policy = transforms.cut(lora_policy(), 1.5)
    x = jax.random.normal(jax.random.key(0), (6, 5))
    stack = call(policy.model, x)[1].active_rank
    assert stack.shape == (LAYERS, 6)
    policy.model(x)
    others = lorasp_jax.collect_aux(policy.model)
    ranks = [*stack[:, 0], *(float(aux.active_rank[0]) for aux in others.values())]
    assert len(ranks) == MATRICES
    assert np.mean(ranks) == 1.5
    assert all(isinstance(m, AdaLoRA) for m in adaptation.methods(policy.model).values())
    largest = int(max(stack[:, 0]))
    assert policy.model.blocks.adapter.get_value()["lora_a"].shape == (LAYERS, WIDTH, largest)


def test_ties_keep_the_first_layers():
    """All singular values are 1: six of twelve are kept, from the start of the model."""
    model = lorasp_jax.adapt(
        Net(nnx.Rngs(0)), [("blocks|heads", LoRA(rank=2, alpha=2.0))], rngs=nnx.Rngs(1)
    )
    for location in paths.locate(nnx.List([model]), Dense):
        if location.child.adapter is not None:
            shape = location.child.kernel_matrices().shape
            a, b = np.eye(shape[-2], 2), np.eye(2, shape[-1])
            params = {"lora_a": a, "lora_b": b}
            params = {n: np.broadcast_to(p, (*shape[:-2], *p.shape)) for n, p in params.items()}
            location.child.adapter = AdapterParam(jax.tree.map(jnp.float32, params))
    after = updates(transforms.cut(Policy(model.blocks, None), 1.0))[""]
    assert [np.linalg.matrix_rank(u) for u in after] == [2, 1, 0]


def test_a_target_beyond_reach_keeps_everything():
    policy = lora_policy()
    before, after = updates(policy), updates(transforms.cut(policy, 100.0))
    for path in before:
        np.testing.assert_allclose(after[path], before[path], atol=1e-5)


def test_rank_zero_is_the_base():
    policy = transforms.cut(lora_policy(), 0.0)
    x = jax.random.normal(jax.random.key(0), (6, 5))
    np.testing.assert_allclose(
        call(policy.model, x)[0], call(Net(nnx.Rngs(0)), x)[0], rtol=1e-4, atol=1e-5
    )


def test_exact_zeros_do_not_count_as_rank():
    """Rank 1 in each layer, stored as rank 3: a target of 2 cannot be reached."""
    policy = lora_policy(rank=3)
    for location in paths.locate(nnx.List([policy.model]), Dense):
        *stack, d_in, d_out = location.child.kernel_matrices().shape
        product = matrix((d_in, d_out), [1.0], seed=0)
        a = np.concatenate([product, product], 1)[:, :1] @ np.ones((1, 3), np.float32)
        b = np.ones((3, 1), np.float32) @ product[:1]
        params = {"lora_a": a, "lora_b": b}
        params = {n: np.broadcast_to(p, (*stack, *p.shape)) for n, p in params.items()}
        location.child.adapter = AdapterParam(jax.tree.map(jnp.asarray, params))
    methods = adaptation.methods(transforms.cut(policy, 2.0).model).values()
    assert {method.rank for method in methods} == {1}


@pytest.mark.slow
def test_pruning_drops_directions_that_no_task_uses(tmp_path, monkeypatch):
    """Two directions of the output layer are never active."""
    monkeypatch.setattr(variants, "BATCH_SIZE", 4)
    monkeypatch.setattr(variants, "BATCHES", 2)
    config = dataclasses.replace(CONFIG, targets=("action_out_proj",))
    run = make_run(tmp_path / "run", config)
    layer = add_noise(run.policy.model, 0.1).action_out_proj
    params = layer.adapter.get_value()
    router = params["router"]
    router = router | {
        "b2": router["b2"].at[jnp.array([1, 4])].set(-30.0),
        "w2": router["w2"].at[:, jnp.array([1, 4])].set(0.0),
    }
    layer.adapter = AdapterParam(params | {"router": router})
    smaller = transforms.pruned(run.policy, run.episodes)
    after = smaller.model.action_out_proj.adapter.get_value()
    assert after["bank"]["u"].shape == (6, params["bank"]["u"].shape[1])
    np.testing.assert_array_equal(after["bank"]["u"], np.delete(params["bank"]["u"], [1, 4], 0))
    assert cost.adapter_bytes(smaller) < cost.adapter_bytes(run.policy)
    assert smaller.processor is run.policy.processor
