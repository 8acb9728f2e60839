"""Compare openpi's LoRA with the einsums in its models/lora.py."""

import flax.traverse_util
import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest
from flax import nnx

from lorasp_jax.models.checkpoints import layouts, published
from lorasp_jax.models.checkpoints.native import base_arrays
from lorasp_jax.models.pi0 import Pi0Config, openpi_lora, published_names
from tests.models.random_models import random_backbone

CONFIG = Pi0Config.dummy()
LAYERS = "PaliGemma/llm/layers"
RANK = {"": 3, "_1": 2}
BATCH, TOKENS = 2, 3


@pytest.fixture(scope="module")
def model():
    return random_backbone(CONFIG)


@pytest.fixture(scope="module")
def leaves():
    """LoRA of both experts, in openpi's shapes."""
    rng, leaves = np.random.default_rng(1), {}
    for size, suffix in ((CONFIG.language, ""), (CONFIG.action, "_1")):
        kernels = {
            f"attn/q_einsum{suffix}/": (size.heads, size.width, size.head_dim),
            f"attn/kv_einsum{suffix}/": (2, size.kv_heads, size.width, size.head_dim),
            f"attn/attn_vec_einsum{suffix}/": (size.heads, size.head_dim, size.width),
            f"mlp{suffix}/gating_einsum_": (2, size.width, size.mlp),
            f"mlp{suffix}/linear_": (size.mlp, size.width),
        }
        for name, (*outer, d_in, d_out) in kernels.items():
            for side, shape in (("a", (d_in, RANK[suffix])), ("b", (RANK[suffix], d_out))):
                leaf = rng.normal(size=(size.depth, *outer, *shape)).astype(np.float32)
                leaves[f"{LAYERS}/{name}lora_{side}"] = leaf
    return leaves


@pytest.mark.parametrize(("tower", "suffix"), [("language", ""), ("action", "_1")])
def test_the_layers_compute_openpis_einsums(model, leaves, tower, suffix):
    adapted = openpi_lora.attach(model, leaves)
    size, layer = getattr(CONFIG, tower), 1
    rng = np.random.default_rng(2)

    def pair(name):
        return (leaves[f"{LAYERS}/{name}lora_{side}"][layer] for side in "ab")

    def delta(name, x):
        """The adapter's contribution to our layer's output."""
        dense = getattr(getattr(adapted, tower).blocks, name)
        params = {key: np.asarray(a)[layer] for key, a in dense.adapter.get_value().items()}
        return np.asarray(jax.jit(dense.method.delta)(params, np.float32(x))[0])

    def close(actual, expected):
        np.testing.assert_allclose(actual, expected.reshape(actual.shape), rtol=1e-4, atol=1e-4)

    x = rng.normal(size=(BATCH, TOKENS, size.width))
    a, b = pair(f"attn/q_einsum{suffix}/")
    inner = np.einsum("BTD,NDL->BTNL", x, a)
    close(delta("q_proj", x), np.einsum("BTNL,NLH->BTNH", inner, b))
    a, b = pair(f"attn/kv_einsum{suffix}/")
    inner = np.einsum("BSD,zKDL->zBSKL", x, a)
    k, v = np.einsum("zBSKL,zKLH->zBSKH", inner, b)
    close(delta("k_proj", x), k)
    close(delta("v_proj", x), v)
    a, b = pair(f"mlp{suffix}/gating_einsum_")
    close(delta("gate_proj", x), x @ a[0] @ b[0])
    close(delta("up_proj", x), x @ a[1] @ b[1])

    x = rng.normal(size=(BATCH, TOKENS, size.heads, size.head_dim))
    a, b = pair(f"attn/attn_vec_einsum{suffix}/")
    inner = np.einsum("BTNH,NHL->BTL", x, a)
    close(delta("o_proj", x.reshape(BATCH, TOKENS, -1)), np.einsum("BTL,NLD->BTD", inner, b))
    x = rng.normal(size=(BATCH, TOKENS, size.mlp))
    a, b = pair(f"mlp{suffix}/linear_")
    close(delta("down_proj", x), x @ a @ b)


def test_a_checkpoint_with_lora_is_loaded(model, leaves, tmp_path):
    """openpi saves base and LoRA in one tree; here only the language expert has LoRA."""
    language = {name: leaf for name, leaf in leaves.items() if "_1" not in name}
    base = layouts.to_theirs(published_names.openpi_layout(CONFIG), base_arrays(model))
    tree = flax.traverse_util.unflatten_dict({**base, **language}, sep="/")
    ocp.PyTreeCheckpointer().save(tmp_path / "params", {"params": tree})
    loaded, unused = published.load_published(tmp_path, CONFIG)
    assert unused == []
    expected = openpi_lora.attach(model, language)
    assert expected.action.blocks.q_proj.adapter is None
    loaded, expected = (nnx.to_flat_state(nnx.state(m, nnx.Param)) for m in (loaded, expected))
    for (path, leaf), (expected_path, expected_leaf) in zip(loaded, expected, strict=True):
        assert path == expected_path
        jax.tree.map(np.testing.assert_array_equal, leaf.get_value(), expected_leaf.get_value())


def test_mismatched_leaves_are_named(model, leaves):
    missing = f"{LAYERS}/mlp_1/linear_lora_b"
    incomplete = {name: leaf for name, leaf in leaves.items() if name != missing}
    with pytest.raises(ValueError, match=f"lacks {missing}"):
        openpi_lora.attach(model, incomplete)
    with pytest.raises(ValueError, match="state_proj/lora_a"):
        openpi_lora.attach(model, {**leaves, "state_proj/lora_a": np.zeros(1)})
    wide = {**leaves, f"{LAYERS}/mlp/linear_lora_a": np.zeros((2, 7, 3), np.float32)}
    with pytest.raises(ValueError, match="mlp/linear_lora_a"):
        openpi_lora.attach(model, wide)
