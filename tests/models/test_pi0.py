"""Properties of pi0, without recorded values: sizes and attention masks."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.transformer.layers import block_mask
from tests.models.random_models import observation, random_backbone

CONFIG = Pi0Config.dummy()
BATCH = 2


def size(model: nnx.Module) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(nnx.state(model, nnx.Param)))


def actions(seed: int = 1) -> jax.Array:
    return jax.random.normal(jax.random.key(seed), (BATCH, CONFIG.chunk, CONFIG.action_dim))


@pytest.fixture(scope="module")
def obs():
    return observation(CONFIG, BATCH)


@pytest.fixture(scope="module")
def model():
    return random_backbone(CONFIG)


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("base", 3_238_048_528, 3_238_048_528), ("small", 8e6, 10e6), ("nano", 0.9e6, 1.2e6)],
)
def test_parameter_counts(name, low, high):
    config = getattr(Pi0Config, name)()
    assert low <= size(nnx.eval_shape(lambda: config.create(nnx.Rngs(0)))) <= high


def test_base_towers():
    """Counts from shape evaluation in openpi: SigLIP with its head, both experts, one expert."""
    model = nnx.eval_shape(lambda: Pi0Config.base().create(nnx.Rngs(0)))
    assert size(model.vision) == 414_803_696
    assert size(model.language) + size(model.action) == 2_819_996_672
    assert size(model.action) == 311_464_960


def test_inconsistent_sizes_raise():
    with pytest.raises(ValueError, match=r"depth of both experts must be equal, .* got 2 and 3"):
        dataclasses.replace(CONFIG, action=dataclasses.replace(CONFIG.action, depth=3))
    with pytest.raises(ValueError, match=r"image_size must be a multiple of .* = 16, got 40"):
        dataclasses.replace(CONFIG, image_size=40)


def test_every_action_attends_to_every_action(model, obs):
    time = jnp.full(BATCH, 0.4)
    velocity = jax.jit(lambda x_t: model.velocity(obs, x_t, time))
    x_t = actions()
    last = np.abs(velocity(x_t.at[:, -1].add(1.0)) - velocity(x_t))
    assert (last.max(axis=-1) > 1e-6).all()


def test_state_does_not_attend_to_actions(model, obs):
    """The action expert's output at the state token is the same for any x_t."""

    def state_row(x_t: jax.Array) -> jax.Array:
        prefix, _ = model.run_prefix(obs)
        tokens, _ = model.embed_suffix(obs, x_t, jnp.full(BATCH, 0.4))
        block = np.array([1] + [2] * CONFIG.chunk)
        key_block = np.concatenate([np.zeros(prefix.valid.shape[1], int), block])
        valid = jnp.ones(tokens.shape[:2], bool)
        key_valid = jnp.concatenate([prefix.valid, valid], axis=1)
        mask = block_mask(block, key_block, valid, key_valid)
        position = jnp.broadcast_to(jnp.arange(tokens.shape[1]), tokens.shape[:2])
        return model.action(tokens, position, mask, prefix.cache, token_mask=valid)[0][:, 0]

    row = jax.jit(state_row)
    np.testing.assert_array_equal(row(actions(1)), row(actions(2)))
