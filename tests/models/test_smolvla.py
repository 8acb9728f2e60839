"""Properties of SmolVLA, without recorded values: sizes, attention masks, layers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from lorasp_jax import models
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.smolvla import SmolVLAConfig, published_names
from lorasp_jax.models.transformer.layers import rope, rope_table
from lorasp_jax.models.transformer.siglip import patches
from tests.models.random_models import random_backbone

CONFIG = SmolVLAConfig.dummy()
BATCH = 2
LINEARS = ("q_proj", "k_proj", "v_proj", "o_proj", "gate_proj", "up_proj", "down_proj")


def parameters(model: nnx.Module) -> dict:
    return nnx.to_pure_dict(nnx.state(model, nnx.Param))


def size(model: nnx.Module) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(parameters(model)))


def normal(seed: int, *shape: int) -> jax.Array:
    return jax.device_put(np.random.default_rng(seed).normal(size=shape).astype(np.float32))


@pytest.fixture(scope="module")
def model():
    return random_backbone(CONFIG)


@pytest.fixture(scope="module")
def base():
    return nnx.eval_shape(lambda: SmolVLAConfig.base().create(nnx.Rngs(0)))


@pytest.mark.parametrize(
    ("name", "low", "high"), [("medium", 6e7, 1e8), ("small", 8e6, 10e6), ("nano", 0.9e6, 1.2e6)]
)
def test_parameter_counts(name, low, high):
    config = getattr(SmolVLAConfig, name)()
    assert low <= size(nnx.eval_shape(lambda: config.create(nnx.Rngs(0)))) <= high


def test_base_towers(base):
    """Counts of lerobot/smolvla_base: in total, language and vision, action expert."""
    assert size(base) == 450_046_176
    assert size(base.vision) + size(base.language) == 350_165_184
    assert size(base.action) == 98_245_840


def test_base_has_the_published_tensors(base):
    """Check names and shapes of 500 tensors with broadcast arrays, which take no memory."""
    zero = np.zeros((), np.int8)
    ours = {
        jax.tree_util.keystr(path, simple=True, separator="/"): np.broadcast_to(zero, leaf.shape)
        for path, leaf in jax.tree_util.tree_leaves_with_path(parameters(base))
    }
    theirs = {
        f"model.{name}": array.shape
        for rule in published_names.lerobot_layout(base.config)
        for name, array in zip(
            rule.theirs, rule.to_theirs(*(ours.pop(n) for n in rule.ours)), strict=True
        )
    }
    assert not ours
    assert len(theirs) == 500
    assert sum(np.prod(shape) for shape in theirs.values()) == 450_046_176
    vlm, expert = "model.vlm_with_expert.vlm.", "model.vlm_with_expert.lm_expert."
    vision = f"{vlm}model.vision_model.embeddings."
    for name, shape in {
        f"{vision}patch_embedding.weight": (768, 3, 16, 16),
        f"{vision}position_embedding.weight": (1024, 768),
        f"{vlm}model.connector.modality_projection.proj.weight": (960, 12288),
        f"{vlm}model.text_model.layers.15.self_attn.k_proj.weight": (320, 960),
        f"{vlm}lm_head.weight": (49280, 960),
        f"{expert}layers.14.self_attn.k_proj.weight": (320, 720),
        f"{expert}layers.15.self_attn.k_proj.weight": (320, 320),
        f"{expert}layers.0.mlp.down_proj.weight": (720, 2048),
        "model.state_proj.weight": (960, 32),
        "model.action_time_mlp_in.weight": (720, 1440),
    }.items():
        assert theirs[name] == shape, name


def test_inconsistent_sizes_raise():
    language, action = (dataclasses.replace(e, depth=3) for e in (CONFIG.language, CONFIG.action))
    with pytest.raises(ValueError, match="depth"):
        dataclasses.replace(CONFIG, language=language, action=action)
    with pytest.raises(ValueError, match="image_size"):
        dataclasses.replace(CONFIG, image_size=40)


def test_own_checkpoint_round_trip(model, tmp_path):
    models.save(tmp_path, model)
    loaded = models.load(tmp_path)
    assert loaded.config == dataclasses.replace(CONFIG, unroll=None)  # unroll is not saved
    jax.tree.map(
        lambda a, b: np.testing.assert_array_equal(a, np.asarray(b, jnp.bfloat16)),
        parameters(loaded),
        parameters(model),
    )


def test_pixel_shuffle():
    """Merged token (i, j) holds its square of tokens in row-major order, channels last."""
    grid = np.arange(8 * 8 * 3).reshape(1, 8, 8, 3)
    merged = np.asarray(jax.jit(patches, static_argnums=1)(grid, 4))
    square = [grid[0, 4 + dy, dx, c] for dy in range(4) for dx in range(4) for c in range(3)]
    assert merged.shape == (1, 4, 48)
    np.testing.assert_array_equal(merged[0, 2], square)


def test_actions_attend_only_to_earlier_actions(model):
    images = {name: normal(i, BATCH, 32, 32, 3) for i, name in enumerate(CONFIG.cameras)}
    obs = Observation(
        images=images,
        image_masks={name: np.ones(BATCH, bool) for name in images},
        tokens=np.arange(BATCH * CONFIG.max_tokens, dtype=np.int32).reshape(BATCH, -1),
        token_mask=np.ones((BATCH, CONFIG.max_tokens), bool),
        state=normal(2, BATCH, CONFIG.action_dim),
    )
    velocity = jax.jit(lambda x_t: model.velocity(obs, x_t, jnp.full(BATCH, 0.4)))
    x_t = np.array(normal(3, BATCH, CONFIG.chunk, CONFIG.action_dim))
    other = x_t.copy()
    other[:, 1] += 1
    change = np.abs(np.subtract(velocity(other), velocity(x_t))).max(axis=-1)
    assert not change[:, 0].any()
    assert (change[:, 1:] > 1e-6).all()


def test_cross_attention(model):
    """Compare with a NumPy implementation: no second RoPE on keys, only valid keys attended."""
    graphdef, stacked = nnx.split(model.action.blocks.cross_layer)
    block = nnx.merge(graphdef, jax.tree.map(lambda a: np.asarray(a)[1], stacked))
    size, tokens, keys = CONFIG.action, 3, 5
    cache = (normal(4, 1, keys, size.kv_heads, 16), normal(5, 1, keys, size.kv_heads, 16))
    valid = np.array([[True, True, False, True, True]])
    x, table = (
        normal(6, 1, tokens, size.width),
        jax.jit(rope_table, static_argnums=1)(np.arange(tokens)[None], 16),
    )
    mask = np.broadcast_to(valid[:, None], (1, tokens, keys))

    @jax.jit
    def run(cache, x, table):
        keys_values, _ = block.project_cache(cache, valid)
        return block.attend(x, table, mask, keys_values, np.ones((1, tokens), bool))

    result, aux = jax.device_get(run(cache, x, table))
    assert aux.keys() == {"q_proj", "o_proj", "gate_proj", "up_proj", "down_proj"}

    kernel = {name: np.asarray(getattr(block, name).kernel[...], np.float64) for name in LINEARS}
    k, v = (
        (np.asarray(a, np.float64).reshape(keys, -1) @ kernel[name]).reshape(keys, -1, 16)
        for a, name in zip(cache, ("k_proj", "v_proj"), strict=True)
    )
    h = norm(np.asarray(x, np.float64)[0], block.input_layernorm)
    q = np.float32(h @ kernel["q_proj"]).reshape(1, tokens, -1, 16)
    q = np.asarray(jax.jit(rope)(q, table))[0]
    attended = np.zeros((tokens, size.heads, 16))
    for head in range(size.heads):
        kv_head = head // (size.heads // size.kv_heads)
        logits = np.asarray(q, np.float64)[:, head] @ k[:, kv_head].T / 4
        weight = np.exp(logits - logits.max(1, keepdims=True)) * np.asarray(valid)
        attended[:, head] = (weight / weight.sum(1, keepdims=True)) @ v[:, kv_head]
    y = np.asarray(x, np.float64)[0] + attended.reshape(tokens, -1) @ kernel["o_proj"]
    h = norm(y, block.post_attention_layernorm)
    gate = h @ kernel["gate_proj"]
    y += (gate / (1 + np.exp(-gate)) * (h @ kernel["up_proj"])) @ kernel["down_proj"]
    np.testing.assert_allclose(result[0], y, rtol=1e-5, atol=1e-5)


def norm(x: np.ndarray, layer: nnx.Module) -> np.ndarray:
    scale = np.asarray(layer.scale[...], np.float64)
    return x / np.sqrt((x**2).mean(-1, keepdims=True) + 1e-5) * scale
