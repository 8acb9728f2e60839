"""One device and eight agree; large frozen arrays are split."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from lorasp_jax import adaptation
from lorasp_jax.data.batches import flatten, sample_batch
from lorasp_jax.training import mesh as meshes
from lorasp_jax.training.step import loss_fn
from tests.runs import leaves, make_run


def test_one_and_eight_devices_agree(tmp_path):
    run = make_run(tmp_path / "run")
    graphdef, adapters, frozen = adaptation.split(run.policy.model)
    # Adapters as they are after some training: at zero, half of the gradients would vanish.
    keys = iter(jax.random.split(jax.random.key(3), 1000))
    adapters = jax.tree.map(lambda x: x + 0.1 * jax.random.normal(next(keys), x.shape), adapters)
    batch = sample_batch(
        jax.random.key(0),
        flatten(list(run.episodes.values())),
        run.policy.processor,
        batch_size=16,
        chunk=run.policy.model.config.chunk,
        state_noise=0.0,
    )
    weights = {"spectral": 1e-2, "balance": 1e-3, "z": 1e-3}

    def gradients(mesh):
        place = meshes.replicated(mesh)
        return jax.jit(jax.value_and_grad(loss_fn, has_aux=True), static_argnums=2)(
            jax.device_put(adapters, place),
            meshes.place_frozen(frozen, mesh, minimum=1024),
            graphdef,
            jax.device_put(batch, meshes.batch_sharding(mesh)),
            jax.device_put(jax.random.key(1), place),
            weights,
        )

    (one, _), grads_one = gradients(meshes.make_mesh(1, jax.devices()[:1]))
    (eight, metrics), grads_eight = gradients(meshes.make_mesh(2))
    assert float(eight) == pytest.approx(float(one), rel=1e-5)
    assert {"task", "spectral", "balance", "z", "active_rank/action"} <= set(metrics)
    for name, expected in leaves(grads_one).items():
        scale = np.abs(expected).max()
        assert scale > 0, name
        np.testing.assert_allclose(
            leaves(grads_eight)[name], expected, atol=1e-4 * scale, rtol=0, err_msg=name
        )


def test_sharding_rule():
    mesh = meshes.make_mesh(4)
    assert dict(mesh.shape) == {"data": 2, "fsdp": 4}
    big, odd, little = jnp.zeros((6, 4096, 1024)), jnp.zeros((1025, 1025)), jnp.zeros((8, 8))
    assert meshes.frozen_sharding(big, mesh).spec == PartitionSpec(None, "fsdp", None)
    assert meshes.frozen_sharding(odd, mesh).spec == PartitionSpec()
    assert meshes.frozen_sharding(little, mesh).spec == PartitionSpec()
    assert meshes.frozen_sharding(little, mesh, minimum=1).spec == PartitionSpec("fsdp", None)


def test_fsdp_must_divide_the_devices():
    with pytest.raises(ValueError, match="fsdp = 3 does not divide the 8 devices"):
        meshes.make_mesh(3)
