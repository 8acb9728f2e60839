"""Compare pi0 with values recorded from openpi (tests/golden/pi0_tiny, fp32)."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from lorasp_jax.models.checkpoints import published
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.pi0 import ExpertConfig, Pi0Config, VisionConfig
from lorasp_jax.models.transformer.layers import block_mask, positions
from tests import GOLDEN

GOLDEN = GOLDEN / "pi0_tiny"
EXPERT = ExpertConfig(width=64, depth=4, mlp=128, heads=8, kv_heads=1, head_dim=16)
CONFIG = Pi0Config(
    vision=VisionConfig(width=32, depth=2, mlp=48, heads=2, patch=14),
    language=EXPERT,
    action=EXPERT,
    cameras=("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb"),
    image_size=56,
    vocabulary=512,
    max_tokens=7,
    chunk=5,
    action_dim=32,
)


def arrays(name: str) -> dict[str, np.ndarray]:
    with np.load(GOLDEN / f"{name}.npz") as file:
        return dict(file)


@pytest.fixture(scope="module")
def model():
    config = dataclasses.replace(CONFIG, unroll=False)  # compiles faster
    return published.load_published(GOLDEN / "orbax", config)[0]


@pytest.fixture(scope="module")
def inputs():
    return arrays("inputs")


@pytest.fixture(scope="module")
def expected():
    return arrays("outputs")


@pytest.fixture(scope="module")
def obs(inputs):
    def per_camera(prefix: str) -> dict[str, jax.Array]:
        return {name: jnp.asarray(inputs[f"{prefix}/{name}"]) for name in CONFIG.cameras}

    return Observation(
        images=per_camera("image"),
        image_masks=per_camera("image_mask"),
        tokens=jnp.asarray(inputs["tokens"]),
        token_mask=jnp.asarray(inputs["token_mask"]),
        state=jnp.asarray(inputs["state"]),
    )


def assert_close(actual, expected, atol):
    np.testing.assert_allclose(np.asarray(actual), expected, rtol=0, atol=atol)


@pytest.fixture(scope="module")
def loss_and_grad(model, obs, inputs):
    """(noise, time) -> ((mean, loss `[B, C]`), gradients), compiled once."""
    graphdef, parameters = nnx.split(model)

    def mean_loss(parameters, noise, time):
        per_element, _ = nnx.merge(graphdef, parameters).loss(
            jax.random.key(0), obs, jnp.asarray(inputs["actions"]), noise=noise, flow_time=time
        )
        return per_element.mean(), per_element.mean(axis=-1)

    compiled = jax.jit(jax.value_and_grad(mean_loss, has_aux=True))
    return lambda noise, time: compiled(parameters, jnp.asarray(noise), jnp.asarray(time))


def test_prefix(model, obs, expected):
    both = jax.jit(lambda model, obs: (model.embed_prefix(obs)[:2], model.run_prefix(obs)[0]))
    (tokens, valid), prefix = both(model, obs)
    assert np.array_equal(valid, expected["prefix_mask"])
    assert_close(tokens, expected["prefix_tokens"], 1e-5 * np.abs(expected["prefix_tokens"]).max())
    out = np.asarray(prefix.out)[np.asarray(prefix.valid)]
    assert_close(out, expected["prefix_out"][expected["prefix_mask"]], 1e-4)


def test_suffix_and_velocity(model, obs, inputs, expected):
    x_t, time = jnp.asarray(expected["x_t"]), jnp.asarray(inputs["time"])
    tokens, v_t = jax.jit(
        lambda model: (model.embed_suffix(obs, x_t, time)[0], model.velocity(obs, x_t, time))
    )(model)
    assert_close(tokens, expected["suffix_tokens"], 5e-5)
    assert_close(v_t, expected["v_t"], 1e-4)


def test_masks_and_positions(expected):
    """Prefix and suffix as one sequence have openpi's mask and positions."""
    valid = np.concatenate([expected["prefix_mask"], expected["suffix_mask"]], axis=1)
    block = np.array([0] * expected["prefix_mask"].shape[1] + [1] + [2] * CONFIG.chunk)
    assert np.array_equal(block_mask(block, block, valid, valid), expected["attn_mask"])
    assert np.array_equal(positions(jnp.asarray(valid)), expected["positions"])


def test_loss_and_gradients(loss_and_grad, inputs, expected):
    (mean, loss), grads = loss_and_grad(inputs["noise"], inputs["time"])
    assert_close(loss, expected["loss"], 1e-4)
    assert_close(mean, expected["mean_loss"], 1e-4)
    grads = nnx.to_pure_dict(grads)
    norm = np.sqrt(sum(np.sum(np.square(g)) for g in jax.tree.leaves(grads)))
    assert_close(norm, expected["grad_norm_all"], 1e-3 * expected["grad_norm_all"])
    assert not np.any(grads["language"]["norm"]["scale"])

    vision, language = grads["vision"]["blocks"], grads["language"]["blocks"]
    keys_values = [language[name]["kernel"] for name in ("k_proj", "v_proj")]
    actual = {
        "PaliGemma/img/Transformer/encoderblock/MlpBlock_0/Dense_0/kernel": vision["fc1"]["kernel"],
        "action_time_mlp_in/kernel": grads["action_time_mlp_in"]["kernel"],
        "PaliGemma/llm/layers/attn/kv_einsum/w": np.stack(keys_values, axis=1)[:, :, None],
    }
    for name, grad in actual.items():
        recorded = expected[f"grad/{name}"]
        assert_close(grad, recorded, 1e-3 * np.abs(recorded).max())


def test_sampling(model, obs, inputs, expected):
    noise = jnp.asarray(inputs["noise"])
    sample = jax.jit(lambda m, o: m.sample_actions(jax.random.key(0), o, noise=noise))(model, obs)
    assert_close(sample, expected["sample"], 1e-4)


def test_loss_with_noise_drawn_by_openpi(loss_and_grad, expected):
    recorded = {name: expected[f"compute_loss_check/{name}"] for name in ("noise", "time", "loss")}
    (_, loss), _ = loss_and_grad(recorded["noise"], recorded["time"])
    assert_close(loss, recorded["loss"], 3e-4)
