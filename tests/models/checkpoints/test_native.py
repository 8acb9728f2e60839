import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax import models
from lorasp_jax.models.checkpoints import native
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import LoRA
from tests.models.random_models import random_backbone

CONFIG = Pi0Config.dummy()


@pytest.fixture(scope="module")
def model():
    return random_backbone(CONFIG)


@pytest.fixture
def folder(tmp_path, model):
    models.save(tmp_path / "base", model)
    return tmp_path / "base"


def parameters(model: nnx.Module) -> dict:
    return nnx.to_pure_dict(nnx.state(model, nnx.Param))


def test_round_trip_is_exact_in_bfloat16(folder, model):
    loaded, expected = models.load(folder), dataclasses.replace(CONFIG, unroll=None)
    assert loaded.config == expected
    jax.tree.map(
        lambda a, b: np.testing.assert_array_equal(
            a, np.asarray(b).astype(jnp.bfloat16).astype("f")
        ),
        parameters(loaded),
        parameters(model),
    )
    assert models.load_config(folder) == expected


def test_config_sets_the_runtime_fields(folder):
    config = dataclasses.replace(CONFIG, dtype="bfloat16", param_dtype="bfloat16", remat="full")
    loaded = models.load(folder, config)
    assert loaded.config == config
    assert {leaf.dtype for leaf in jax.tree.leaves(parameters(loaded))} == {jnp.dtype("bfloat16")}
    assert models.weights_hash(loaded) == models.weights_hash(folder)


def test_hash_covers_the_base_without_adapters(folder, model):
    loaded = models.load(folder)
    assert models.weights_hash(loaded) == models.weights_hash(folder)
    adapted = lorasp_jax.adapt(loaded, [("state_proj", LoRA(rank=2))], rngs=nnx.Rngs(0))
    assert models.weights_hash(adapted) == models.weights_hash(folder)
    assert models.weights_hash(model) != models.weights_hash(folder)  # not yet rounded to bf16
    for has_adapters in (adapted, lorasp_jax.combine({"own": adapted})):
        with pytest.raises(ValueError, match="without adapters"):
            models.save(folder, has_adapters)
    with pytest.raises(ValueError, match="quantiz"):
        models.save(folder, lorasp_jax.quantize(loaded, [("state_proj", "int8")]).model)
    with pytest.raises(ValueError, match="URL"):
        models.save("gs://bucket/base", loaded)


def test_shards_respect_the_maximum_size(tmp_path, model, monkeypatch):
    monkeypatch.setattr(native, "SHARD_BYTES", 80_000)
    models.save(tmp_path, model)
    shards = sorted(tmp_path.glob("model-*.safetensors"))
    assert len(shards) > 2
    assert all(shard.stat().st_size < 80_000 + 2**16 for shard in shards)
    monkeypatch.undo()
    sharded = models.weights_hash(tmp_path)
    assert models.weights_hash(models.load(tmp_path)) == sharded
    shards[1].unlink()
    with pytest.raises(ValueError, match=shards[1].name):
        models.load(tmp_path)
    models.save(tmp_path, model)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["config.json", "model.safetensors"]
    assert models.weights_hash(tmp_path) == sharded


def test_wrong_sizes_raise(folder):
    other = dataclasses.replace(CONFIG, image_size=64)
    with pytest.raises(ValueError, match=r"image_size is 32 in the folder, 64 in the config$"):
        models.load(folder, other)


def test_weights_load_with_other_lengths(folder):
    """As runs with `--model.max-tokens` or `--model.chunk` need; the file keeps its own."""
    other = dataclasses.replace(CONFIG, max_tokens=9, chunk=7)
    loaded, stored = models.load(folder, other), models.load(folder)
    assert loaded.config == other
    assert (stored.config.max_tokens, stored.config.chunk) == (CONFIG.max_tokens, CONFIG.chunk)
    assert models.weights_hash(loaded) == models.weights_hash(stored)


def edit_config(folder, **change):
    path = folder / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))


def test_damaged_and_foreign_folders_raise(folder):
    with pytest.raises(ValueError, match=r"config\.json is missing"):
        native.load_native(folder / "nothing")
    sizes = json.loads((folder / "config.json").read_text())["config"]
    edit_config(folder, config={**sizes, "vocabulary": 7})
    with pytest.raises(ValueError, match="hash"):
        models.load(folder)
    edit_config(folder, config=sizes, sha256="0" * 64)
    with pytest.raises(ValueError, match="hash"):
        models.load(folder)
    for change in ({"backbone": "no_such"}, {"config": {"vision": {}}}):
        edit_config(folder, **{"config": sizes, "backbone": "pi0", **change})
        with pytest.raises(ValueError, match=r"config\.json"):
            models.load(folder)
    (folder / "config.json").write_text('{"architectures": []}')
    with pytest.raises(ValueError, match=r"config\.json"):
        native.load_native(folder)


def test_a_truncated_file_raises(folder):
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"model\.safetensors is damaged"):
        models.load(folder)


def test_set_arrays_lists_missing_and_unexpected_arrays(model):
    with pytest.raises(ValueError, match=r"missing .*action/blocks/down_proj/kernel"):
        models.set_arrays(model, {})
    arrays = native.named_arrays(model)
    with pytest.raises(ValueError, match=r"unexpected .*lm_head"):
        models.set_arrays(model, {**arrays, "lm_head": np.zeros(1)})
