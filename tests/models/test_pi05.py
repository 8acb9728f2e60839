"""pi0.5: sizes, its two published layouts, and its velocity against a NumPy implementation."""

import dataclasses
import re

import jax
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.models import presets
from lorasp_jax.models.checkpoints import layouts, native, published
from lorasp_jax.models.pi0 import Pi0Config, published_names
from lorasp_jax.peft import LoRA
from tests.models.random_models import observation, random_backbone
from tests.nets import trained

CONFIG = dataclasses.replace(Pi0Config.dummy(), pi05=True)
BATCH = 2
NORMS = {"input_layernorm/dense", "post_attention_layernorm/dense", "norm/dense"}
PROJECTIONS = {"action_in_proj", "action_out_proj", "time_mlp_in", "time_mlp_out"}


@pytest.fixture(scope="module")
def model():
    return random_backbone(CONFIG)


@pytest.fixture(scope="module")
def obs():
    return observation(CONFIG, BATCH)


@pytest.fixture(scope="module")
def actions():
    shape = (BATCH, CONFIG.chunk, CONFIG.action_dim)
    return np.random.default_rng(1).normal(size=shape).astype(np.float32)


def sizes(config):
    model = nnx.eval_shape(lambda: config.create(nnx.Rngs(0)))
    return {name: leaf.shape for name, leaf in native.named_arrays(model).items()}


def test_parameter_count():
    shapes = sizes(Pi0Config.base_pi05())
    assert sum(int(np.prod(shape)) for shape in shapes.values()) == 3_353_433_872
    assert shapes["action/blocks/input_layernorm/dense/kernel"] == (18, 1024, 3072)
    assert not any("state_proj" in name or "action/norm/scale" in name for name in shapes)
    assert Pi0Config.base_pi05().max_tokens == 200


def test_published_names_and_shapes():
    """openpi has 51 leaves; LeRobot has a weight and a bias for each norm of 18 layers."""
    config = Pi0Config.base_pi05()
    ours = sizes(config)
    rules = {layout: make(config) for layout, make in published_names.LAYOUTS.items()}
    names = {layout: [n for r in rs for n in r.theirs] for layout, rs in rules.items()}
    assert len(names["openpi"]) == 51
    assert len(names["lerobot"]) + len(published_names.UNUSED) == 778 + 37 - 2
    assert all(published_names.lerobot_name(name) == name for name in names["lerobot"])

    def their_shapes(rule):
        zeros = [np.broadcast_to(np.zeros((), np.int8), ours[name]) for name in rule.ours]
        return zip(rule.theirs, (array.shape for array in rule.to_theirs(*zeros)), strict=True)

    new = re.compile("norm|time_mlp")  # the others are as in pi0, and too large to stack here
    shapes = dict(
        pair
        for layout_rules in rules.values()
        for rule in layout_rules
        if new.search(rule.ours[0])
        for pair in their_shapes(rule)
    )
    layers, expert = "PaliGemma/llm/layers", "paligemma_with_expert.gemma_expert.model"
    for name, shape in {
        f"{layers}/pre_attention_norm_1/Dense_0/kernel": (18, 1024, 3072),
        f"{layers}/pre_ffw_norm_1/Dense_0/bias": (18, 3072),
        f"{layers}/pre_ffw_norm/scale": (18, 2048),
        "PaliGemma/llm/final_norm_1/Dense_0/kernel": (1024, 3072),
        "time_mlp_in/kernel": (1024, 1024),
        f"{expert}.layers.17.input_layernorm.dense.weight": (3072, 1024),
        f"{expert}.layers.0.post_attention_layernorm.dense.bias": (3072,),
        f"{expert}.norm.dense.weight": (3072, 1024),
        "time_mlp_out.bias": (1024,),
    }.items():
        assert shapes[name] == shape, name


@pytest.mark.parametrize("layout", ["openpi", "lerobot"])
def test_round_trip(layout, model, tmp_path):
    published.save(tmp_path / "new", model, layout)
    loaded, _ = published.load_published(tmp_path / "new", CONFIG)
    loaded, expected = native.named_arrays(loaded), native.named_arrays(model)
    assert loaded.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(loaded[name], array, err_msg=name)
    with pytest.raises(ValueError, match=r"lacks .*state_proj"):
        published.load_published(tmp_path / "new", Pi0Config.dummy())


def test_adaptive_norm_kernels_are_transposed_for_lerobot(model):
    arrays = {name: np.asarray(leaf) for name, leaf in native.named_arrays(model).items()}
    theirs = layouts.to_theirs(published_names.lerobot_layout(CONFIG), arrays)
    name = "paligemma_with_expert.gemma_expert.model.layers.1.input_layernorm.dense.weight"
    expected = arrays["action/blocks/input_layernorm/dense/kernel"][1].T
    np.testing.assert_array_equal(theirs[name], expected)


def test_cached_path_equals_one_pass_over_the_whole_sequence(model, obs, actions):
    """Compare with joint attention of both experts, layer by layer, in fp64 (as in openpi)."""
    time = np.array([0.3, 0.9], np.float32)
    run = jax.jit(lambda obs, x_t: (model.velocity(obs, x_t, time), model.embed_prefix(obs)[:2]))
    v_t, (tokens, valid) = run(obs, actions)
    p = {n: np.asarray(a, np.float64) for n, a in native.named_arrays(model).items()}
    expected = joint_pass(
        p, np.float64(tokens), np.asarray(valid), np.float64(actions), np.float64(time)
    )
    np.testing.assert_allclose(v_t, expected, rtol=1e-4, atol=1e-4)
    sampled = jax.eval_shape(lambda: model.sample_actions(jax.random.key(0), obs))
    assert sampled.shape == actions.shape
    other_state = dataclasses.replace(obs, state=obs.state + 1)
    np.testing.assert_array_equal(run(other_state, actions)[0], v_t)


def joint_pass(p, prefix, valid, x_t, time):
    """Compute v_t `[B, C, A]` with prefix and actions as two blocks of one sequence."""
    size, width = CONFIG.action, CONFIG.action.width

    def linear(name, x):
        return x @ p[f"{name}/kernel"] + p.get(f"{name}/bias", 0)

    def silu(x):
        return x / (1 + np.exp(-x))

    def gelu(x):
        return 0.5 * x * (1 + np.tanh(np.sqrt(2 / np.pi) * (x + 0.044715 * x**3)))

    def rms(x):
        return x / np.sqrt((x**2).mean(-1, keepdims=True) + 1e-6)

    period = 4e-3 * 1000 ** np.linspace(0, 1, width // 2)
    angle = 2 * np.pi * time[:, None] / period
    condition = np.concatenate([np.sin(angle), np.cos(angle)], axis=-1)
    for name in ("time_mlp_in", "time_mlp_out"):
        condition = silu(linear(name, condition))

    def adaptive(x, kernel, bias):
        scale, shift, gate = np.split((condition @ kernel + bias)[:, None], 3, axis=-1)
        return rms(x) * (1 + scale) + shift, gate

    chunk = x_t.shape[1]
    block = np.array([0] * prefix.shape[1] + [1] * chunk)
    valid = np.concatenate([valid, np.ones((len(valid), chunk), bool)], axis=1)
    mask = (block[None, :] <= block[:, None]) & valid[:, None] & valid[:, :, None]
    position = np.cumsum(valid, axis=1) - 1
    rate = position[:, :, None, None] / 10_000 ** (np.arange(0, size.head_dim, 2) / size.head_dim)

    def rotate(x):
        first, second = np.split(x, 2, axis=-1)
        sin, cos = np.sin(rate), np.cos(rate)
        return np.concatenate([first * cos - second * sin, second * cos + first * sin], axis=-1)

    x, y = prefix, linear("action_in_proj", x_t)
    for i in range(size.depth):
        language, action = (
            {
                name.removeprefix(f"{tower}/blocks/"): array[i]
                for name, array in p.items()
                if name.startswith(f"{tower}/blocks/")
            }
            for tower in ("language", "action")
        )

        def norms(name, x, y, language=language, action=action):
            kernel, bias = action[f"{name}/dense/kernel"], action[f"{name}/dense/bias"]
            return rms(x) * (1 + language[f"{name}/scale"]), *adaptive(y, kernel, bias)

        h, k, gate = norms("input_layernorm", x, y)
        heads = [
            np.concatenate(
                [h @ language[f"{n}_proj/kernel"], k @ action[f"{n}_proj/kernel"]], axis=1
            )
            for n in "qkv"
        ]
        q, keys, values = (a.reshape(*a.shape[:2], -1, size.head_dim) for a in heads)
        q, keys = rotate(q) / size.head_dim**0.5, rotate(keys)
        keys, values = (a.repeat(size.heads // size.kv_heads, axis=2) for a in (keys, values))
        logits = np.where(mask[:, None], np.einsum("btnh,bsnh->bnts", q, keys), -1e30)
        weight = np.exp(logits - logits.max(-1, keepdims=True))
        weight = weight / weight.sum(-1, keepdims=True)
        attended = np.einsum("bnts,bsnh->btnh", weight, values).reshape(*mask.shape[:2], -1)
        x = x + attended[:, :-chunk] @ language["o_proj/kernel"]
        y = y + gate * (attended[:, -chunk:] @ action["o_proj/kernel"])
        h, k, gate = norms("post_attention_layernorm", x, y)

        def mlp(x, expert):
            inner = gelu(x @ expert["gate_proj/kernel"]) * (x @ expert["up_proj/kernel"])
            return inner @ expert["down_proj/kernel"]

        x, y = x + mlp(h, language), y + gate * mlp(k, action)
    y, _ = adaptive(y, p["action/norm/dense/kernel"], p["action/norm/dense/bias"])
    return linear("action_out_proj", y)


def test_a_step_updates_adapters_of_every_dense_layer(model, obs, actions):
    """Including those of the norms, whose aux counts one condition per sample."""
    rules = presets.rules("expert-only", LoRA(rank=2))
    graphdef, adapters, frozen = lorasp_jax.split(trained(*rules, seed=1, net=model, size=0.1))

    @jax.jit
    def step(adapters):
        def loss(adapters):
            model = nnx.merge(graphdef, adapters, frozen)
            per_element, aux = model.loss(jax.random.key(2), obs, actions)
            return per_element.mean(), aux

        (value, aux), grads = jax.value_and_grad(loss, has_aux=True)(adapters)
        return value, aux, jax.tree.map(lambda a, g: a - 0.03 * g, adapters, grads)

    first, aux, stepped = step(adapters)
    assert step(stepped)[0] < first
    experts = {f"{name}_proj" for name in ("q", "k", "v", "o", "gate", "up", "down")}
    assert aux["action"].keys() == NORMS | PROJECTIONS | experts
    norm_aux = aux["action"]["input_layernorm/dense"]
    assert norm_aux.token_mask.shape == (CONFIG.action.depth, BATCH, 1)
    assert norm_aux.token_mask.all()
    changed = jax.tree.map(lambda a, b: np.any(np.not_equal(a, b)), adapters, stepped)
    assert all(all(leaf.get_value().values()) for _, leaf in nnx.to_flat_state(changed))
