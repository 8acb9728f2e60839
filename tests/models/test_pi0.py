"""Properties of pi0, without recorded values: sizes and attention masks."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from lorasp_jax.models.observation import Observation
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.pi0.pi0 import Pi0, Pi0Prefix
from lorasp_jax.models.transformer.layers import block_mask, positions
from tests.models.random_models import observation, random_backbone, with_random_parameters

CONFIG = Pi0Config.dummy()
BATCH = 2


def size(model: nnx.Module) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(nnx.state(model, nnx.Param)))


def actions(seed: int = 1) -> np.ndarray:
    shape = (BATCH, CONFIG.chunk, CONFIG.action_dim)
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.fixture(scope="module")
def obs():
    return observation(CONFIG, BATCH)


@pytest.fixture(scope="module")
def model():
    return random_backbone(CONFIG)


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("base", 3_238_048_528, 3_238_048_528),
        ("medium", 6e7, 1e8),
        ("small", 8e6, 10e6),
        ("nano", 0.9e6, 1.2e6),
    ],
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
    with pytest.raises(ValueError, match="both experts"):
        dataclasses.replace(CONFIG, action=dataclasses.replace(CONFIG.action, depth=3))
    with pytest.raises(ValueError, match="image_size"):
        dataclasses.replace(CONFIG, image_size=40)


def test_every_action_attends_to_every_action(model, obs):
    velocity = jax.jit(lambda x_t: model.velocity(obs, x_t, jnp.full(BATCH, 0.4)))
    x_t, other = actions(), actions()
    other[:, -1] += 1
    last = np.abs(np.subtract(velocity(other), velocity(x_t)))
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


THREE_CAMERAS = dataclasses.replace(CONFIG, cameras=("left", "side", "wrist"))


def gaps():
    """The first example lacks the middle camera, the second the first one; both have padding."""
    cameras = THREE_CAMERAS.cameras
    obs = jax.device_get(observation(THREE_CAMERAS, BATCH))
    present = np.array([[True, False, True], [False, True, True]])
    # Different images, so that their order matters.
    images = {name: np.roll(obs.images[name], 3 * i, axis=2) for i, name in enumerate(cameras)}
    masks = dict(zip(cameras, present.T, strict=True))
    # As long, so that both examples without their gaps run in one program.
    valid = np.tile(np.arange(CONFIG.max_tokens) < 4, (BATCH, 1))
    return dataclasses.replace(obs, images=images, image_masks=masks, token_mask=valid)


def compact(obs, example):
    """One example without its missing camera and without padding."""
    one = jax.tree.map(lambda x: x[example : example + 1], obs)
    cameras = [name for name, present in one.image_masks.items() if present[0]]
    length = int(one.token_mask.sum())
    return dataclasses.replace(
        one,
        images={f"{i}": one.images[name] for i, name in enumerate(cameras)},
        image_masks={f"{i}": one.image_masks[name] for i, name in enumerate(cameras)},
        tokens=one.tokens[:, :length],
        token_mask=one.token_mask[:, :length],
    )


@pytest.mark.parametrize("pi05", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_missing_cameras_and_padding_are_as_if_left_out(pi05):
    config = dataclasses.replace(THREE_CAMERAS, pi05=pi05)
    model, obs, x_t, time = (
        random_backbone(config),
        gaps(),
        actions(),
        np.array([0.3, 0.8], np.float32),
    )
    velocity = jax.jit(lambda model, *inputs: model.velocity(*inputs))
    v_t = np.asarray(velocity(model, obs, x_t, time))
    for i in range(BATCH):
        one = compact(obs, i)
        assert len(one.images) == 2
        model.config = dataclasses.replace(config, cameras=tuple(one.images))
        expected = np.asarray(velocity(model, one, x_t[i : i + 1], time[i : i + 1]))
        np.testing.assert_allclose(v_t[i], expected[0], rtol=1e-4, atol=1e-5)


class Masked(Pi0):
    """pi0 with the prefix in its original order and a mask."""

    def run_prefix(self, obs: Observation):
        tokens, valid, vision_aux = self.embed_prefix(obs)
        block = np.zeros(valid.shape[1], int)
        mask = block_mask(block, block, valid, valid)
        out, cache, aux = self.language(tokens, positions(valid), mask, token_mask=valid)
        return Pi0Prefix(cache, valid, out), {**vision_aux, "language": aux}


def test_a_masked_prefix_gives_the_same_loss_gradients_and_samples():
    obs, x_t = gaps(), actions()

    def results(make):
        graphdef, parameters = nnx.split(
            with_random_parameters(lambda: make(THREE_CAMERAS, rngs=nnx.Rngs(0)))
        )

        def loss(parameters):
            model = nnx.merge(graphdef, parameters)
            return model.loss(jax.random.key(2), obs, x_t)[0].mean()

        def sample(parameters):
            sampler = nnx.merge(graphdef, parameters).sampler()
            return sampler.sample_actions(jax.random.key(0), obs, noise=x_t, num_steps=2)

        return jax.jit(lambda p: (jax.value_and_grad(loss)(p), sample(p)))(parameters)

    close = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5)
    jax.tree.map(close, results(Pi0), results(Masked))
