"""Adapters on disk: round trips for every method, and files that do not fit."""

import json

import jax
import numpy as np
import pytest
from flax import nnx

from lorasp_jax import adaptation, peft
from lorasp_jax.adapter_io import load_adapters, save_adapters
from lorasp_jax.dense import Dense
from lorasp_jax.peft import FullFineTuning, LoRA, LoRASP

SP = LoRASP(rank=8, hidden_width=4, energy_target=0.8)


class Net(nnx.Module):
    def __init__(self, rngs):
        self.first = nnx.Linear(3, 4, rngs=rngs)
        self.blocks = nnx.vmap(lambda r: Dense(4, 4, rngs=r))(rngs.split(2))
        self.norm = nnx.RMSNorm(4, rngs=rngs)


def adapted(*rules, seed=1):
    return adaptation.adapt(Net(nnx.Rngs(0)), rules, rngs=nnx.Rngs(seed))


def assert_same(one, two):
    (graph, *states), (other, *others) = adaptation.split(one), adaptation.split(two)
    assert graph == other
    for a, b in zip(jax.tree.leaves(states), jax.tree.leaves(others), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


@pytest.fixture
def saved(tmp_path):
    save_adapters(tmp_path / "run", adapted((".*", SP)), base="abc", metadata={"step": 3})
    return tmp_path / "run"


@pytest.mark.parametrize("name", peft.names())
def test_round_trip(tmp_path, name):
    """Onto the bare base, which the file adapts, and onto a model adapted alike."""
    rule = (".*", peft.create(name))
    model = adapted(rule)
    save_adapters(tmp_path, model)
    assert_same(load_adapters(tmp_path, Net(nnx.Rngs(0))), model)
    assert_same(load_adapters(tmp_path, adapted(rule, seed=2)), model)


def test_mixed_methods(tmp_path):
    model = adapted(("bias|norm", FullFineTuning()), ("first", LoRA(rank=2)), (".*", SP))
    save_adapters(tmp_path, model)
    assert_same(load_adapters(tmp_path, Net(nnx.Rngs(0))), model)


def test_what_the_file_says(saved):
    description = json.loads((saved / "adapter.json").read_text())
    assert (description["base"], description["metadata"]) == ("abc", {"step": 3})
    assert description["methods"]["blocks"]["method"] == "lora_sp"
    assert description["methods"]["blocks"]["energy_target"] == 0.8
    assert "gate" not in description["methods"]["blocks"]
    assert {path.name for path in saved.iterdir()} == {"adapter.json", "adapter.safetensors"}


def test_another_base(saved):
    load_adapters(saved, Net(nnx.Rngs(0)), base="abc")
    with pytest.raises(ValueError, match="was trained on base 'abc', not on 'xyz'"):
        load_adapters(saved, Net(nnx.Rngs(0)), base="xyz")


def test_models_that_do_not_fit(saved):
    with pytest.raises(ValueError, match="other adapters than the model, first at 'blocks'"):
        load_adapters(saved, adapted((".*", LoRA(rank=2))))
    with pytest.raises(ValueError, match=r"does not fit the model: rule '\^blocks\$'"):
        load_adapters(saved, nnx.Dict(first=nnx.Linear(3, 4, rngs=nnx.Rngs(0))))
    other = Net(nnx.Rngs(0))
    other.first = nnx.Linear(7, 4, rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match=r"tensor 'first/adapter/bank/v' has shape \(3, 8\) in"):
        load_adapters(saved, other)


@pytest.mark.parametrize("field", ["rank", "hidden_width", "pruned"])
@pytest.mark.parametrize("size", [10**12, 10**30])
def test_sizes_beyond_any_memory(saved, field, size):
    """Are compared with the tensors before anything is made."""
    path = saved / "adapter.json"
    description = json.loads(path.read_text())
    for settings in description["methods"].values():
        settings[field] = size
    path.write_text(json.dumps(description))
    with pytest.raises(ValueError, match=r"does not fit|has shape") as caught:
        load_adapters(saved, Net(nnx.Rngs(0)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("adapter.safetensors", lambda data: data[:-10], "is damaged or belongs to another"),
        ("adapter.safetensors", lambda _: b"", "is damaged or belongs to another"),
        ("adapter.json", lambda data: data[:50], "is damaged or no adapter description"),
        ("adapter.json", lambda _: b'{"r": 8}', "is damaged or no adapter description"),
        ("adapter.json", lambda _: b"[1]", "is damaged or no adapter description"),
        ("adapter.json", lambda d: d.replace(b'"version": 1', b'"version": 9'), "of version 1"),
        ("adapter.json", lambda d: d.replace(b"lora_sp", b"lora_ps"), "did you mean 'lora_sp'"),
        ("adapter.json", lambda d: d.replace(b'"rank": 8', b'"rank": "8"'), "does not fit"),
    ],
)
def test_damaged_files(saved, name, damage, message):
    (saved / name).write_bytes(damage((saved / name).read_bytes()))
    with pytest.raises(ValueError, match=message):
        load_adapters(saved, Net(nnx.Rngs(0)))


def test_missing_files(tmp_path, saved):
    with pytest.raises(ValueError, match=r"holds no adapter\.json; an adapter is a"):
        load_adapters(tmp_path, Net(nnx.Rngs(0)))
    (saved / "adapter.safetensors").unlink()
    with pytest.raises(ValueError, match=r"holds no adapter\.safetensors"):
        load_adapters(saved, Net(nnx.Rngs(0)))


def test_a_failed_save_keeps_the_old_adapter(saved):
    before = {path.name: path.read_bytes() for path in saved.iterdir()}
    with pytest.raises(ValueError, match="no adapters to save"):
        save_adapters(saved, Net(nnx.Rngs(0)))
    with pytest.raises(TypeError):
        save_adapters(saved, adapted((".*", SP), seed=5), metadata={"bad": object()})
    assert {path.name: path.read_bytes() for path in saved.iterdir()} == before
