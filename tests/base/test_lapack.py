"""LAPACK calls that JAX 0.10 and 0.11.0 would share out among XLA's threads."""

import os
import subprocess
import sys

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

import envs  # noqa: F401 (splits the calls)

INDEPENDENT = """
import jax, jax.numpy as jnp, envs

@jax.jit
def factor(matrices):
    return [jnp.linalg.cholesky(matrices * scale) for scale in range(1, 31)]

for _ in range(30):
    jax.block_until_ready(factor(jnp.broadcast_to(jnp.eye(30), (46, 30, 30))))
"""


def test_independent_calls_on_two_threads_do_not_hang():
    environment = os.environ | {"PJRT_NPROC": "2"}  # XLA's threads
    command = [sys.executable, "-c", INDEPENDENT]
    subprocess.run(command, env=environment, check=True, timeout=60)  # 4 s


@pytest.mark.parametrize("batch", [(), (3,), (2, 5)])  # 60 x 60: 3 per call
def test_split_calls_compute_the_same(batch):
    root = np.random.default_rng(0).normal(size=(*batch, 60, 60))
    matrices = root @ root.swapaxes(-1, -2) + 60 * np.eye(60)
    right = root[..., :2]
    assert np.allclose(jnp.linalg.cholesky(matrices), np.linalg.cholesky(matrices), atol=1e-4)
    factor = jax.scipy.linalg.cho_factor(matrices)
    for solved in (jnp.linalg.solve(matrices, right), jax.scipy.linalg.cho_solve(factor, right)):
        assert np.allclose(solved, np.linalg.solve(matrices, right), atol=1e-5)


def test_calls_that_are_not_split():
    (worlds,) = jax.export.symbolic_shape("worlds")
    matrices = jax.ShapeDtypeStruct((worlds, 16, 16), jnp.float32)
    assert jax.export.export(jax.jit(jnp.linalg.cholesky))(matrices).out_avals[0].shape[0] == worlds
    identities = jnp.broadcast_to(jnp.eye(16), (4096, 16, 16))
    assert jnp.linalg.solve(identities, jnp.zeros((4096, 16, 0))).shape == (4096, 16, 0)


def test_a_call_is_split_only_if_jax_would_share_it_out():
    def loops(worlds):
        matrices = jax.ShapeDtypeStruct((worlds, 14, 14), jnp.float32)
        return jax.jit(jnp.linalg.cholesky).lower(matrices).as_text().count("stablehlo.while")

    assert loops(219) == 0
    assert loops(220) == (jax.__version_info__ < (0, 11, 1))
