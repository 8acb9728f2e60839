"""Adapt third-party Gemma models unchanged: Flax's example (NNX) and Hugging Face's (Linen)."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax import LinenAdapter
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io.native import load_adapters, save_adapters
from lorasp_jax.dense import AdapterParam
from lorasp_jax.peft import LoRA, LoRASP
from tests import gemmas
from tests.models.random_models import with_noise

pytestmark = pytest.mark.slow

SP = LoRASP(rank=8, hidden_width=4)
TOKENS = jnp.array([[1, 2, 3, 4, 5], [5, 5, 2, 1, 0]])
POSITIONS = jnp.broadcast_to(jnp.arange(5), (2, 5))
MASK = jnp.broadcast_to(jnp.tril(jnp.ones((5, 5), bool)), (2, 5, 5))


@pytest.fixture(scope="module")
def gemma():
    """Return a Gemma with random weights."""
    model = gemmas.Gemma(nnx.Rngs(0))
    graphdef, params, rest = nnx.split(model, nnx.Param, ...)
    return nnx.merge(graphdef, with_noise(params, 0.2), rest)


def called(model):
    return model(TOKENS, POSITIONS, None, MASK)[0]


logits = jax.jit(called)


def adapted(gemma, *rules):
    return adaptation.adapt(gemma, rules, rngs=nnx.Rngs(1))


def trained(model, steps=5):
    """Train a few steps; return the model and the loss before and after."""
    graphdef, adapters, frozen = adaptation.split(model)
    optimizer = optax.adam(1e-2)

    def loss(adapters):
        y = called(nnx.merge(graphdef, adapters, frozen))
        return optax.softmax_cross_entropy_with_integer_labels(y, TOKENS).mean()

    @jax.jit
    def step(adapters, opt_state):
        value, gradients = jax.value_and_grad(loss)(adapters)
        updates, opt_state = optimizer.update(gradients, opt_state)
        return optax.apply_updates(adapters, updates), opt_state, value

    opt_state, losses = optimizer.init(adapters), []
    for _ in range(steps):
        adapters, opt_state, value = step(adapters, opt_state)
        losses.append(float(value))
    return nnx.merge(graphdef, adapters, frozen), losses


def test_nnx_gemma_trains_saves_and_loads(gemma, tmp_path):
    model = adapted(gemma, ("0/attn", SP), ("attn|mlp", LoRA(rank=2)))
    before = logits(model)
    np.testing.assert_allclose(before, logits(gemma), rtol=1e-3, atol=1e-4)
    assert len(adaptation.methods(model)) == 2 * 6
    model, losses = trained(model)
    assert losses[-1] < losses[0] - 0.05
    save_adapters(tmp_path, model)
    np.testing.assert_array_equal(logits(load_adapters(tmp_path, gemma)), logits(model))
    _, aux = jax.jit(lambda m: (called(m), lorasp_jax.collect_aux(m)))(model)
    rows = {row.split()[0]: row.split() for row in lorasp_jax.summary(model, aux).splitlines()}
    assert rows["layers/0/attn/kv_einsum"][2:4] == ["2x2x16x8", "8"]
    assert 1 <= float(rows["layers/0/attn/kv_einsum"][-1]) <= 8


def test_nnx_gemma_merges_into_its_own_parameters(gemma):
    model = adapted(gemma, ("attn|mlp", LoRA(rank=2)))
    # One adapter for all heads, like Hugging Face's q_proj, k_proj and v_proj, with k and v fused.
    sizes = [(16, 32), (16, 32), (32, 16), (16, 24), (16, 24), (24, 16)]
    assert adaptation.count(model).trainable == 2 * sum(2 * (i + o) for i, o in sizes)
    graphdef, adapters, frozen = adaptation.split(model)
    model = nnx.merge(graphdef, with_noise(adapters, 0.3), frozen)
    merged = lorasp_jax.merge(model)
    assert not jax.tree.leaves(nnx.state(merged, AdapterParam))
    loaded = nnx.merge(nnx.graphdef(gemma), nnx.state(merged))
    assert jnp.abs(logits(model) - logits(gemma)).max() > 0.1
    np.testing.assert_allclose(logits(loaded), logits(model), rtol=1e-3, atol=1e-3)


def test_nnx_gemma_with_named_adapters_and_quantization(gemma):
    """The model reads sizes from its kernels, so quantized kernels must keep their shapes."""
    pour, press = (adapted(gemma, (".*", LoRA(rank=rank))) for rank in (2, 3))
    graphdef, adapters, frozen = adaptation.split(pour)
    pour = nnx.merge(graphdef, with_noise(adapters, 0.3), frozen)
    both = lorasp_jax.combine({"pour": pour, "press": press})
    np.testing.assert_allclose(logits(both), logits(pour), rtol=1e-3, atol=1e-4)
    unmerged = lorasp_jax.unmerge(lorasp_jax.merge(pour), pour)
    np.testing.assert_allclose(logits(unmerged), logits(pour), rtol=1e-3, atol=1e-4)
    small, errors = lorasp_jax.quantize(pour, [("attn|mlp", "int8")])
    assert len(errors) == 2 * 6
    error = jnp.linalg.norm(logits(small) - logits(pour)) / jnp.linalg.norm(logits(pour))
    assert 0 < error < 0.03


@pytest.fixture(scope="module")
def linen():
    """Return the Gemma of Hugging Face transformers, and its parameters."""
    gemma = pytest.importorskip(
        "transformers.models.gemma.modeling_flax_gemma", exc_type=ImportError
    )
    config = gemma.GemmaConfig(
        vocab_size=gemmas.VOCABULARY,
        hidden_size=gemmas.WIDTH,
        intermediate_size=gemmas.MLP,
        num_hidden_layers=2,
        num_attention_heads=gemmas.HEADS,
        num_key_value_heads=gemmas.KV_HEADS,
        head_dim=gemmas.HEAD,
        hidden_activation="gelu_pytorch_tanh",
        max_position_embeddings=32,
    )
    module = gemma.FlaxGemmaForCausalLMModule(config)
    arguments = (TOKENS, jnp.ones_like(TOKENS), POSITIONS)
    return module, jax.jit(module.init)(jax.random.key(0), *arguments), arguments


def test_linen_gemma(linen):
    module, published, arguments = linen
    rules = [("0/self_attn/[qv]_proj", SP), ("mlp|embed_tokens", LoRA(rank=2))]
    adapter = LinenAdapter(module, rules)
    variables = jax.jit(adapter.attach)(jax.random.key(1), published, *arguments)
    expected = jax.jit(module.apply)(published, *arguments).logits
    run = jax.jit(lambda v: adapter.apply(v, *arguments).logits)
    np.testing.assert_allclose(run(variables), expected, rtol=1e-4, atol=1e-5)
    assert len(variables["adapters"]["model"]["layers"]["0"]["self_attn"]) == 2

    @jax.jit
    def gradient(adapters):
        def loss(adapters):
            out, updated = adapter.apply(
                variables | {"adapters": adapters}, *arguments, mutable=["intermediates"]
            )
            labels = optax.softmax_cross_entropy_with_integer_labels(out.logits, TOKENS)
            return labels.mean(), lorasp_jax.collect_aux(updated)

        return jax.value_and_grad(loss, has_aux=True)(adapters)

    adapters, losses, optimizer = variables["adapters"], [], optax.adam(1e-3)
    opt_state = optimizer.init(adapters)
    for _ in range(6):
        (value, aux), gradients = gradient(adapters)
        updates, opt_state = optimizer.update(gradients, opt_state)
        adapters = optax.apply_updates(adapters, updates)
        losses.append(float(value))
    assert losses[-1] < losses[0] - 0.01
    assert len(aux) == 2 + 2 * 3 + 1
    assert aux["model/layers/0/self_attn/q_proj"].active_rank.shape == (2, 5)


def test_linen_gemma_merges(linen):
    module, published, arguments = linen
    # The head shares the embedding table, so merging into it would change the head too.
    adapter = LinenAdapter(module, [("embed_tokens", None), (".*", LoRA(rank=2))])
    variables = jax.jit(adapter.attach)(jax.random.key(1), published, *arguments)
    variables = with_noise(variables, 0.1)
    merged = jax.jit(adapter.merge)(variables, *arguments)
    assert jax.tree.map(jnp.shape, merged) == jax.tree.map(jnp.shape, published)
    expected = jax.jit(adapter.apply)(variables, *arguments).logits
    actual = jax.jit(module.apply)(merged, *arguments).logits
    np.testing.assert_allclose(actual, expected, rtol=1e-3, atol=1e-3)
