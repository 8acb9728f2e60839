"""Save and load adapters: round trips for every method, and invalid files."""

import json
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from lorasp_jax import peft
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io.native import load_adapters, save_adapters
from lorasp_jax.base.digest import with_digest
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
    """Load adapters into the bare base and into a model with the same adapters."""
    rule = (".*", peft.create(name))
    model = adapted(rule)
    save_adapters(tmp_path, model)
    assert_same(load_adapters(tmp_path, Net(nnx.Rngs(0))), model)
    assert_same(load_adapters(tmp_path, adapted(rule, seed=2)), model)


def test_mixed_methods(tmp_path):
    model = adapted(("bias|norm", FullFineTuning()), ("first", LoRA(rank=2)), (".*", SP))
    save_adapters(tmp_path, model)
    assert_same(load_adapters(tmp_path, Net(nnx.Rngs(0))), model)


def test_description(saved):
    description = json.loads((saved / "adapter.json").read_text())
    assert (description["base"], description["metadata"]) == ("abc", {"step": 3})
    assert description["methods"]["blocks"]["method"] == "lora_sp"
    assert description["methods"]["blocks"]["energy_target"] == 0.8
    assert {path.name for path in saved.iterdir()} == {"adapter.json", "adapter.safetensors"}


def test_base_with_another_name(saved):
    load_adapters(saved, Net(nnx.Rngs(0)), base="abc")
    with pytest.raises(ValueError, match="'abc', not 'xyz'"):
        load_adapters(saved, Net(nnx.Rngs(0)), base="xyz")


def with_changed_array(model, change):
    """Copy of the model with a change to its first frozen array."""
    graphdef, adapters, frozen = adaptation.split(model)
    first, *others = jax.tree.leaves(frozen)
    frozen = jax.tree.unflatten(jax.tree.structure(frozen), [change(first), *others])
    return nnx.merge(graphdef, adapters, frozen)


@pytest.mark.parametrize("bare", [True, False])
def test_different_weights_of_the_same_shapes(saved, bare):
    model = Net(nnx.Rngs(0)) if bare else adapted((".*", SP))
    other = with_changed_array(model, lambda kernel: kernel.at[0, 0].add(0.5))
    with pytest.raises(ValueError, match=r"'blocks.*any_base=True"):
        load_adapters(saved, other)
    loaded = load_adapters(saved, other, any_base=True)
    assert_same(
        loaded, with_changed_array(load_adapters(saved, model), lambda k: k.at[0, 0].add(0.5))
    )


def test_the_same_weights_in_another_dtype(saved):
    half = jax.tree.map(lambda leaf: leaf.astype(jnp.bfloat16), Net(nnx.Rngs(0)))
    load_adapters(saved, half)
    mesh = jax.make_mesh((2,), ("data",), devices=jax.devices()[:2])
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec(None))
    load_adapters(saved, jax.device_put(Net(nnx.Rngs(0)), sharding))


def test_incompatible_models(saved):
    with pytest.raises(ValueError, match="'blocks'"):
        load_adapters(saved, adapted((".*", LoRA(rank=2))))
    with pytest.raises(ValueError, match=r"'\^blocks\$'"):
        load_adapters(saved, nnx.Dict(first=nnx.Linear(3, 4, rngs=nnx.Rngs(0))))
    other = Net(nnx.Rngs(0))
    other.first = nnx.Linear(7, 4, rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match=r"first/adapter/bank/v is \(3, 8\)"):
        load_adapters(saved, other)


@pytest.mark.parametrize("field", ["rank", "hidden_width"])
@pytest.mark.parametrize("size", [10**12, 10**30])
def test_sizes_larger_than_memory(saved, field, size):
    """Sizes are compared with the tensors before anything is allocated."""
    path = saved / "adapter.json"
    description = json.loads(path.read_text())
    del description["digest"]
    for settings in description["methods"].values():
        settings[field] = size
    path.write_text(json.dumps(with_digest(description)))
    with pytest.raises(ValueError, match=str(saved)) as caught:
        load_adapters(saved, Net(nnx.Rngs(0)))
    assert "\n" not in str(caught.value)


def test_a_failed_save_keeps_the_old_adapter(saved):
    before = {path.name: path.read_bytes() for path in saved.iterdir()}
    with pytest.raises(ValueError, match="no adapters"):
        save_adapters(saved, Net(nnx.Rngs(0)))
    for bad, error in ((object(), TypeError), (float("nan"), ValueError)):
        with pytest.raises(error, match="JSON"):
            save_adapters(saved, adapted((".*", SP), seed=5), metadata={"bad": bad})
    with pytest.raises(ValueError, match="base"):
        save_adapters(saved, adapted((".*", SP), seed=5), base=5)
    assert {path.name: path.read_bytes() for path in saved.iterdir()} == before


@pytest.mark.parametrize("name", ["adapter.json", "adapter.safetensors"])
def test_files_larger_than_memory(saved, name):
    os.truncate(saved / name, 2**43)
    with pytest.raises(ValueError, match=name):
        load_adapters(saved, Net(nnx.Rngs(0)))


def test_settings_that_name_removed_options():
    """Options that LoRA-SP no longer has load at their former defaults, else are refused."""
    method = peft.LoRASP(rank=8)
    removed = {"granularity": "token", "schedule": None, "normalized_bank": False}
    assert peft.from_settings(peft.to_settings(method) | removed) == method
    for other in (
        {"granularity": "sample"},
        {"schedule": {"start": 0.5}},
        {"normalized_bank": True},
    ):
        (name,) = other
        with pytest.raises(ValueError, match=name):
            peft.from_settings(peft.to_settings(method) | removed | other)

    release = peft.to_settings(peft.LoRASPRelease(rank=8))
    assert peft.from_settings(release | {"hidden_width": None}) == peft.LoRASPRelease(rank=8)
    with pytest.raises(ValueError, match="hidden_width"):
        peft.from_settings(release | {"hidden_width": 4})


@pytest.mark.parametrize("name", peft.names())
def test_settings_round_trip(name):
    method = peft.create(name)
    assert peft.from_settings(json.loads(json.dumps(peft.to_settings(method)))) == method
