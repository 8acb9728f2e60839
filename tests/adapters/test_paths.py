"""Locate and replace modules, without changing anything else in the model."""

import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import paths
from lorasp_jax.peft import LoRA


class Net(nnx.Module):
    """A shared einsum, a layer in a list, and a shared `nnx.Linear`."""

    def __init__(self):
        rngs = nnx.Rngs(0)
        self.first = nnx.Einsum("...d,df->...f", (4, 4), rngs=rngs)
        self.second = self.first
        self.several = nnx.List([nnx.LinearGeneral(4, 4, rngs=rngs)])
        self.linear = nnx.Linear(4, 4, rngs=rngs)
        self.again = self.linear


@pytest.fixture
def net():
    return Net()


def modules(net):
    return paths.locate(nnx.List([net]), nnx.Module)


def test_shared_children_are_replaced_once(net):
    calls = []

    def make(location):
        calls.append(location.path)
        return nnx.Dropout(0.5) if location.path in ("second", "linear", "again") else None

    paths.replace([location for location in modules(net) if "several" not in location.path], make)
    assert sorted(calls) == ["", "again", "first", "linear", "second"]
    assert net.first is net.second  # `make` returns None for "first"
    assert type(net.linear) is nnx.Dropout
    assert net.linear is not net.again  # replaced separately


def test_merging_restores_classes(net):
    structure = nnx.graphdef(net)
    model = lorasp_jax.adapt(net, [("first|several", LoRA(rank=2))], rngs=nnx.Rngs(1))
    assert nnx.graphdef(net) == structure
    assert (type(net.first), type(net.several[0])) == (nnx.Einsum, nnx.LinearGeneral)
    assert isinstance(model.first, nnx.Einsum)
    assert model.first is model.second
    assert model.first.kernel is not net.first.kernel
    assert nnx.graphdef(lorasp_jax.merge(model)) == structure
