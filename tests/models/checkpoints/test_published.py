"""Loading and saving checkpoints in openpi's and LeRobot's layouts."""

import dataclasses
import json
from pathlib import Path

import flax.traverse_util
import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import orbax.checkpoint as ocp
import pytest
import safetensors.numpy

from lorasp_jax.models.checkpoints import published
from lorasp_jax.models.checkpoints.native import named_arrays
from lorasp_jax.models.pi0 import Pi0Config, published_names
from tests.models.test_pi0_parity import CONFIG, GOLDEN

OPENPI = GOLDEN / "orbax"
LANGUAGE = "model.paligemma_with_expert.paligemma.model.language_model"
HEAD = "model.paligemma_with_expert.paligemma.lm_head.weight"


@pytest.fixture(scope="module")
def model():
    return published.load_published(OPENPI, CONFIG)[0]


@pytest.fixture(scope="module")
def leaves():
    """openpi's original arrays."""
    return orbax_leaves(OPENPI / "params")


def orbax_leaves(folder):
    checkpointer, folder = ocp.PyTreeCheckpointer(), folder.absolute()
    tree = checkpointer.metadata(folder).item_metadata.tree
    as_numpy = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), tree)
    restored = checkpointer.restore(folder, restore_args=as_numpy)
    assert set(restored) == {"params"}
    return flax.traverse_util.flatten_dict(restored["params"], sep="/")


@pytest.fixture
def tensors(model, tmp_path):
    """The same model in LeRobot's layout."""
    published.save(tmp_path / "lerobot", model, "lerobot")
    return safetensors.numpy.load_file(tmp_path / "lerobot" / "model.safetensors")


def write(folder, tensors):
    folder.mkdir()
    safetensors.numpy.save_file(tensors, folder / "model.safetensors")
    return folder


def assert_same(actual, expected):
    actual, expected = named_arrays(actual), named_arrays(expected)
    assert actual.keys() == expected.keys()
    for name, array in actual.items():
        assert array.dtype == expected[name].dtype
        np.testing.assert_array_equal(array, expected[name], err_msg=name)


def test_openpi_round_trip(model, leaves, tmp_path):
    published.save(tmp_path / "new", model, "openpi")
    saved = orbax_leaves(tmp_path / "new" / "params")
    assert saved.keys() == leaves.keys()
    for name, array in leaves.items():
        np.testing.assert_array_equal(array, saved[name], err_msg=name)
    assert published.load_published(tmp_path / "new" / "params", CONFIG)[1] == []


def test_openpi_saved_from_an_nnx_state(model, leaves, tmp_path):
    """Every path then ends in "value"."""
    tree = flax.traverse_util.unflatten_dict(
        {(*k.split("/"), "value"): jnp.asarray(a) for k, a in leaves.items()}
    )
    ocp.PyTreeCheckpointer().save(tmp_path / "params", {"params": tree})
    assert_same(published.load_published(tmp_path, CONFIG)[0], model)


def test_lerobot_has_the_documented_tensors(tensors, leaves):
    """Check rows of the table in openpi's converter (examples/convert_jax_model_to_pytorch.py)."""
    q = leaves["PaliGemma/llm/layers/attn/q_einsum/w"][1]  # [N, D, H]
    kv = leaves["PaliGemma/llm/layers/attn/kv_einsum_1/w"][2]  # [2, K, D, H]
    out = leaves["PaliGemma/llm/layers/attn/attn_vec_einsum/w"][0]  # [N, H, D]
    vision = leaves[
        "PaliGemma/img/Transformer/encoderblock/MultiHeadDotProductAttention_0/query/kernel"
    ][1]
    patch = leaves["PaliGemma/img/embedding/kernel"]
    expert = "model.paligemma_with_expert.gemma_expert.model.layers.2"
    tower = "model.paligemma_with_expert.paligemma.model.vision_tower.vision_model"
    expected = {
        f"{LANGUAGE}.layers.1.self_attn.q_proj.weight": q.transpose(0, 2, 1).reshape(-1, 64),
        f"{expert}.self_attn.k_proj.weight": kv[0, 0].T,
        f"{expert}.self_attn.v_proj.weight": kv[1, 0].T,
        f"{LANGUAGE}.layers.0.self_attn.o_proj.weight": out.reshape(-1, 64).T,
        f"{expert}.mlp.up_proj.weight": leaves["PaliGemma/llm/layers/mlp_1/gating_einsum"][2, 1].T,
        f"{tower}.encoder.layers.1.self_attn.q_proj.weight": vision.reshape(32, 32).T,
        f"{tower}.embeddings.patch_embedding.weight": patch.transpose(3, 2, 0, 1),
        "model.action_time_mlp_in.weight": leaves["action_time_mlp_in/kernel"].T,
        HEAD: leaves["PaliGemma/llm/embedder/input_embedding"],
    }
    for name, array in expected.items():
        np.testing.assert_array_equal(tensors[name], array, err_msg=name)


def test_lerobot_names_of_the_published_model():
    rules = published_names.lerobot_layout(Pi0Config.base())
    names = {name for rule in rules for name in rule.theirs} | set(published_names.UNUSED)
    assert len(names) == 778
    assert all(published_names.lerobot_name(name) == name for name in names)


def test_lerobot_round_trip(model, tensors, tmp_path):
    loaded, unused = published.load_published(write(tmp_path / "again", tensors), CONFIG)
    assert_same(loaded, model)
    assert unused == [HEAD.removeprefix("model.")]


def test_lerobot_in_bf16_and_in_shards(model, tensors, tmp_path):
    """Stored dtypes can be restored, whatever the model's dtype."""
    mixed = {name: a.astype(ml_dtypes.bfloat16) for name, a in tensors.items()}
    mixed["model.state_proj.bias"] = tensors["model.state_proj.bias"]
    names = sorted(mixed)
    shards = {"a.safetensors": names[:50], "b.safetensors": names[50:]}
    (tmp_path / "shards").mkdir()
    for file, shard in shards.items():
        safetensors.numpy.save_file({n: mixed[n] for n in shard}, tmp_path / "shards" / file)
    index = {"weight_map": {name: file for file, shard in shards.items() for name in shard}}
    (tmp_path / "shards" / "model.safetensors.index.json").write_text(json.dumps(index))
    loaded, _ = published.load_published(tmp_path / "shards", CONFIG)
    assert {a.dtype for a in named_arrays(loaded).values()} == {np.dtype("float32")}
    dtypes = published.stored_dtypes(tmp_path / "shards", CONFIG)
    published.save(tmp_path / "new", loaded, "lerobot", dtypes)
    saved = safetensors.numpy.load_file(tmp_path / "new" / "model.safetensors")
    assert saved.keys() == mixed.keys()
    for name, array in mixed.items():
        assert saved[name].dtype == array.dtype
        np.testing.assert_array_equal(saved[name], array, err_msg=name)
    half = dataclasses.replace(CONFIG, param_dtype="bfloat16")
    loaded, _ = published.load_published(tmp_path / "shards", half)
    assert {a.dtype for a in named_arrays(loaded).values()} == {np.dtype("bfloat16")}


def test_older_lerobot_versions(model, tensors, tmp_path):
    """Towers in other modules, no prefix, and the embedding stored only as the head."""
    old = {}
    for name, array in tensors.items():
        name = name.removeprefix("model.").replace(
            "paligemma.model.language_model", "paligemma.language_model.model"
        )
        old[name.replace("paligemma.model.vision_tower", "paligemma.vision_tower")] = array
    del old["paligemma_with_expert.paligemma.language_model.model.embed_tokens.weight"]
    loaded, unused = published.load_published(write(tmp_path / "old", old), CONFIG)
    assert_same(loaded, model)
    assert unused == []


def test_mismatched_checkpoints_raise(model, tensors, tmp_path):
    lora = {**tensors, "model.extra.lora_A.weight": np.zeros((2, 2), np.float32)}
    with pytest.raises(ValueError, match=r"unexpected .* extra\.lora_A\.weight"):
        published.load_published(write(tmp_path / "more", lora), CONFIG)
    incomplete = {name: a for name, a in tensors.items() if "layers.1.mlp.up_proj" not in name}
    with pytest.raises(ValueError, match=r"lacks .*layers\.1\.mlp\.up_proj\.weight"):
        published.load_published(write(tmp_path / "incomplete", incomplete), CONFIG)
    other = dataclasses.replace(CONFIG, action_dim=7)
    with pytest.raises(ValueError, match=r"state_proj/kernel .*\(32, 64\), expected \(7, 64\)"):
        published.load_published(OPENPI, other)
    twice = {**tensors, "state_proj.bias": np.zeros(64, np.float32)}
    with pytest.raises(ValueError, match=r"state_proj.bias twice"):
        published.load_published(write(tmp_path / "twice", twice), CONFIG)
    with pytest.raises(ValueError, match="neither openpi"):
        published.load_published(tmp_path, CONFIG)
    with pytest.raises(ValueError, match="already exists"):
        published.save(tmp_path / "more", model, "lerobot")
    with pytest.raises(ValueError, match=r"layout .* 'torch'"):
        published.save(tmp_path / "new", model, "torch")
    with pytest.raises(ValueError, match="URL"):
        published.save(Path("gs://bucket/base"), model, "openpi")


@pytest.mark.parametrize("layout", ["lerobot", "openpi"])
def test_damaged_files_raise(layout, model, tmp_path):
    published.save(tmp_path / "new", model, layout)
    if layout == "lerobot":
        file = tmp_path / "new" / "model.safetensors"
        file.write_bytes(file.read_bytes()[:-1000])
    else:
        (tmp_path / "new" / "params" / "_METADATA").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="damaged"):
        published.load_published(tmp_path / "new", CONFIG)
