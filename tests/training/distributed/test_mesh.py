"""One device and several agree; large frozen arrays are sharded."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.sharding import PartitionSpec

from lorasp_jax.adapters import adaptation
from lorasp_jax.data.batches import flatten, sample_batch
from lorasp_jax.peft import FullFineTuning
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.loop import train
from lorasp_jax.training.run_folder import read_metrics
from lorasp_jax.training.step import init_state, loss_fn
from tests.models.random_models import with_noise
from tests.runs import CONFIG, Terminate, leaves, make_run

FEW = ("language/blocks/q_proj", "action_out_proj")


@pytest.mark.parametrize("targets", [FEW, pytest.param(CONFIG.targets, marks=pytest.mark.slow)])
def test_one_and_four_devices_agree(tmp_path, targets):
    """LoRA-SP on single and on scanned layers."""
    run = make_run(tmp_path / "run", dataclasses.replace(CONFIG, targets=targets))
    graphdef, adapters, frozen = adaptation.split(run.policy.model)
    sizes = {"batch_size": 8, "chunk": run.policy.model.config.chunk, "state_noise": 0.0}
    sample = jax.jit(functools.partial(sample_batch, **sizes))
    steps = flatten(list(run.episodes.values()))
    batch = sample(jax.random.key(0), steps, run.policy.processor)
    weights = {"spectral": 1e-2, "balance": 1e-3, "z": 1e-3}

    value_and_grad = jax.jit(jax.value_and_grad(loss_fn, has_aux=True), static_argnums=2)

    def gradients(mesh):
        replicated = meshes.replicated(mesh)
        return value_and_grad(
            jax.device_put(with_noise(adapters, 0.1), replicated),
            jax.device_put(frozen, meshes.shardings(frozen, mesh, minimum=1024)),
            graphdef,
            jax.device_put(batch, meshes.batch_sharding(mesh)),
            jax.device_put(jax.random.key(1), replicated),
            weights,
        )

    (one, _), grads_one = gradients(meshes.make_mesh(1, jax.devices()[:1]))
    # XLA's 8 threads can deadlock in the collectives of 8 devices on a busy machine.
    (four, metrics), grads_four = gradients(meshes.make_mesh(2, jax.devices()[:4]))
    assert float(four) == pytest.approx(float(one), rel=1e-5)
    assert {"task", "spectral", "balance", "z", "active_rank/action"} <= set(metrics)
    for name, expected in leaves(grads_one).items():
        scale = np.abs(expected).max()
        assert scale > 0, name
        np.testing.assert_allclose(
            leaves(grads_four)[name], expected, atol=1e-4 * scale, rtol=0, err_msg=name
        )


def test_sharding_rule():
    mesh = meshes.make_mesh(4)
    assert dict(mesh.shape) == {"data": 2, "fsdp": 4}
    shapes = {"big": (6, 2560, 1024), "odd": (1025, 1025), "small": (8, 8)}

    def zeros():
        adapters = {name: jnp.zeros(shape) for name, shape in shapes.items()}
        return init_state(adapters, optax.adam(0.1), ema=True)

    state = jax.eval_shape(zeros)
    found = meshes.shardings(state, mesh)
    for tree in (found.adapters, found.opt_state[0].mu, found.opt_state[0].nu, found.average):
        assert tree["big"].spec == PartitionSpec(None, "fsdp", None)
        assert tree["odd"].spec == tree["small"].spec == PartitionSpec()
    by_rows = meshes.shardings(state.adapters["small"], mesh, minimum=1)
    assert by_rows.spec == PartitionSpec("fsdp", None)
    placed = jax.jit(zeros, out_shardings=found)()
    on_one = sum(x.addressable_shards[0].data.nbytes for x in jax.tree.leaves(placed))
    assert meshes.bytes_on_device(state, fsdp=4) == on_one < 0.3 * meshes.bytes_on_device(state, 1)


@pytest.mark.slow
def test_sharded_full_fine_tuning_equals_one_device(tmp_path, monkeypatch):
    """Parameters, moments and average are sharded; a run on another mesh resumes with them."""
    sharded = functools.partial(meshes.shardings, minimum=1024)
    monkeypatch.setattr(meshes, "shardings", sharded)
    optim = dataclasses.replace(CONFIG.optim, ema=0.5)
    config = dataclasses.replace(
        CONFIG, peft=FullFineTuning(), targets=("action",), fsdp=2, optim=optim
    )
    many = make_run(tmp_path / "many", config, devices=8)
    with pytest.raises(KeyboardInterrupt):
        train(many, [Terminate()])
    many = make_run(tmp_path / "many", dataclasses.replace(config, fsdp=4), devices=8)
    train(many, resume=True)
    trained = jax.tree.leaves(adaptation.split(many.policy.model)[1])
    shares = [x.addressable_shards[0].data.size / x.size for x in trained]
    assert shares.count(0.25) > 5
    one = make_run(tmp_path / "one", dataclasses.replace(config, fsdp=1))
    train(one)
    rows = zip(read_metrics(one.folder), read_metrics(many.folder), strict=True)
    for expected, found in rows:
        assert found["task"] == pytest.approx(expected["task"], rel=1e-4)
        assert found["grad_norm"] == pytest.approx(expected["grad_norm"], rel=1e-3)


def test_fsdp_must_divide_the_devices():
    with pytest.raises(ValueError, match=r"fsdp must divide the number of devices \(8\), got 3"):
        meshes.make_mesh(3)
