"""Compare SmolVLA with values recorded from LeRobot (tests/golden/smolvla_tiny, fp32).

LeRobot computed velocity, loss and gradients on the whole sequence and sampled with its cache; here
everything uses the cache.
"""

import dataclasses

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest
import safetensors.numpy
from flax import nnx

import lorasp_jax
from lorasp_jax.models.checkpoints import layouts, native, published
from lorasp_jax.models.config import ExpertConfig, VisionConfig
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.smolvla import SmolVLAConfig, published_names
from lorasp_jax.models.transformer.layers import block_mask, positions
from lorasp_jax.peft import LoRA
from tests import GOLDEN

GOLDEN = GOLDEN / "smolvla_tiny"
CONFIG = SmolVLAConfig(
    vision=VisionConfig(width=32, depth=2, mlp=48, heads=4, patch=8, shuffle=4),
    language=ExpertConfig(width=64, depth=4, mlp=96, heads=4, kv_heads=2, head_dim=16),
    action=ExpertConfig(width=48, depth=4, mlp=256, heads=4, kv_heads=2, head_dim=16),
    cameras=("0", "1"),
    image_size=64,
    vocabulary=101,
    max_tokens=6,
    chunk=5,
    action_dim=32,
)
HEAD = "model.vlm_with_expert.vlm.lm_head.weight"


def arrays(name: str) -> dict[str, np.ndarray]:
    with np.load(GOLDEN / f"{name}.npz") as file:
        return dict(file)


@pytest.fixture(scope="module")
def tensors():
    return safetensors.numpy.load_file(GOLDEN / "model.safetensors")


@pytest.fixture(scope="module")
def model():
    config = dataclasses.replace(CONFIG, unroll=False)  # compiles faster
    return published.load_published(GOLDEN, config)[0]


@pytest.fixture(scope="module")
def inputs():
    return jax.device_put(arrays("inputs"))


@pytest.fixture(scope="module")
def expected():
    return arrays("outputs")


@pytest.fixture(scope="module")
def obs(inputs):
    return Observation(
        images={name: inputs[f"image/{name}"].transpose(0, 2, 3, 1) for name in CONFIG.cameras},
        image_masks={name: inputs[f"image_mask/{name}"] for name in CONFIG.cameras},
        tokens=inputs["tokens"].astype(jnp.int32),
        token_mask=inputs["token_mask"],
        state=inputs["state"],
    )


def assert_close(actual, expected, atol):
    np.testing.assert_allclose(np.asarray(actual), expected, rtol=0, atol=atol)


def test_prefix(model, obs, expected):
    both = jax.jit(lambda model: (model.encode_images(obs)[0], model.embed_prefix(obs)[:2]))
    image_tokens, (tokens, valid) = both(model)
    recorded = [expected[f"image_tokens_unscaled/{name}"] for name in CONFIG.cameras]
    assert_close(image_tokens, np.concatenate(recorded, axis=1), 1e-5)
    assert np.array_equal(valid, expected["prefix_pad_mask"])
    assert_close(tokens, expected["prefix_embs"], 2e-5)


def test_suffix_and_velocity(model, obs, inputs, expected):
    """At the recorded time, and at the sampler's first and last step."""
    compiled = jax.jit(
        lambda x_t, t: (model.embed_suffix(obs, x_t, t)[0], model.velocity(obs, x_t, t))
    )
    tokens, v_t = compiled(expected["x_t"], inputs["time"])
    assert_close(tokens, expected["suffix_embs"], 5e-5)
    assert_close(v_t, expected["v_t"], 1e-4)
    _, first = compiled(inputs["noise"], np.ones(2, np.float32))
    assert_close(first, expected["sample_v_first_step"], 1e-4)
    before_last = expected["sample"] + 0.1 * expected["sample_v_last_step"]
    _, last = compiled(before_last, np.full(2, 0.1, np.float32))
    assert_close(last, expected["sample_v_last_step"], 1e-4)


def test_masks_and_positions(expected):
    """Prefix and suffix as one sequence have LeRobot's mask and positions."""
    valid = np.concatenate([expected["prefix_pad_mask"], expected["suffix_pad_mask"]], axis=1)
    marks = np.concatenate([expected["prefix_att_mask"], expected["suffix_att_mask"]], axis=1)
    block = np.array([0] * (expected["prefix_pad_mask"].shape[1] - 1) + [1, 2, 3, 4, 5, 6])
    assert np.array_equal(np.cumsum(marks[0]), block)
    assert np.array_equal(block_mask(block, block, valid, valid), expected["attn_mask_2d"])
    assert np.array_equal(positions(jnp.asarray(valid)), expected["positions"])


def test_loss_and_gradients(model, obs, inputs, expected):
    graphdef, parameters = nnx.split(model)

    def mean_loss(parameters):
        per_element, _ = nnx.merge(graphdef, parameters).loss(
            jax.random.key(0),
            obs,
            inputs["actions"],
            noise=inputs["noise"],
            flow_time=inputs["time"],
        )
        return per_element.mean(), per_element

    (mean, loss), grads = jax.jit(jax.value_and_grad(mean_loss, has_aux=True))(parameters)
    assert_close(loss, expected["loss"], 3e-4)
    assert_close(mean, expected["mean_loss"], 3e-4)
    grads = native.base_arrays(nnx.merge(graphdef, grads))
    theirs = layouts.to_theirs(published_names.lerobot_layout(CONFIG), grads)
    grads = {f"model.{name}": grad for name, grad in theirs.items()}
    names = [name.removeprefix("grad/") for name in expected if name.startswith("grad/")]
    assert len(names) == 3
    for name in names:
        recorded = expected[f"grad/{name}"]
        assert_close(grads[name], recorded, 1e-3 * np.abs(recorded).max())
    last = "model.vlm_with_expert.vlm.model.text_model.layers.3."
    unused = {f"{last}self_attn.{linear}_proj.weight" for linear in "qo"}
    unused |= {f"{last}mlp.{linear}_proj.weight" for linear in ("gate", "up", "down")}
    unused |= {f"{last}post_attention_layernorm.weight", HEAD}
    unused |= {"model.vlm_with_expert.vlm.model.text_model.norm.weight"}
    assert {name for name, grad in grads.items() if not np.any(grad)} == unused


def test_sampling(model, obs, inputs, expected):
    sample = jax.jit(lambda m: m.sample_actions(jax.random.key(0), obs, noise=inputs["noise"]))(
        model
    )
    assert_close(sample, expected["sample"], 1e-4)


def test_saving_restores_every_tensor(model, tensors, tmp_path):
    published.save(tmp_path, model, "lerobot")
    saved = safetensors.numpy.load_file(tmp_path / "model.safetensors")
    assert saved.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert saved[name].dtype == tensor.dtype, name
        np.testing.assert_array_equal(saved[name], tensor)
    adapted = lorasp_jax.adapt(model, [("state_proj", LoRA(rank=2))], rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="without adapters"):
        published.save(tmp_path / "adapted", adapted, "lerobot")


def test_saving_can_restore_the_stored_dtypes(tensors, tmp_path):
    """As in the published file: the projections in fp32, the rest in bf16."""
    mixed = {
        name: tensor if "_proj.bias" in name or name == HEAD else tensor.astype(ml_dtypes.bfloat16)
        for name, tensor in tensors.items()
    }
    (tmp_path / "from").mkdir()
    safetensors.numpy.save_file(mixed, tmp_path / "from" / "model.safetensors")
    loaded, unused = published.load_published(tmp_path / "from", CONFIG)
    assert unused == []
    dtypes = published.stored_dtypes(tmp_path / "from", CONFIG)
    published.save(tmp_path / "to", loaded, "lerobot", dtypes)
    saved = safetensors.numpy.load_file(tmp_path / "to" / "model.safetensors")
    assert {name: t.dtype for name, t in saved.items()} == {n: t.dtype for n, t in mixed.items()}
    for name, tensor in mixed.items():
        assert saved[name].tobytes() == tensor.tobytes(), name


def test_wrong_sizes_raise():
    with pytest.raises(
        ValueError, match=r"embed_tokens.weight .*\(101, 64\), expected \(100, 64\)"
    ):
        published.load_published(GOLDEN, dataclasses.replace(CONFIG, vocabulary=100))


def test_names_without_prefix(model, tensors, tmp_path):
    unprefixed = {name.removeprefix("model."): tensor for name, tensor in tensors.items()}
    safetensors.numpy.save_file(unprefixed, tmp_path / "model.safetensors")
    loaded, _ = published.load_published(tmp_path, CONFIG)
    pairs = zip(jax.tree.leaves(nnx.state(loaded)), jax.tree.leaves(nnx.state(model)), strict=True)
    for actual, expected in pairs:
        np.testing.assert_array_equal(actual, expected)
