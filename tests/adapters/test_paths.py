"""Children are replaced at their places, and nothing else of a model is touched."""

import re

import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import paths
from lorasp_jax.peft import LoRA
from tests import ROOT


class Net(nnx.Module):
    """A layer in two places, one in a list, and one that is an `nnx.Linear` in two."""

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


def found(net):
    return paths.locate(nnx.List([net]), nnx.Module)


def test_what_hangs_in_two_places_is_replaced_once(net):
    asked = []

    def make(location):
        asked.append(location.path)
        return nnx.Dropout(0.5) if location.path in ("second", "linear", "again") else None

    paths.replace([location for location in found(net) if "several" not in location.path], make)
    assert sorted(asked) == ["", "again", "first", "linear", "second"]
    assert net.first is net.second  # no answer for the first place, one for the second
    assert type(net.linear) is nnx.Dropout
    assert net.linear is not net.again  # each place of an `nnx.Linear` has its own


def test_a_child_is_put_into_a_list(net):
    (location,) = (location for location in found(net) if location.path == "several/0")
    paths.set_child(location, nnx.Dropout(0.5))
    assert type(net.several[0]) is nnx.Dropout


def test_adapting_leaves_classes_and_merging_gives_them_back(net):
    structure = nnx.graphdef(net)
    model = lorasp_jax.adapt(net, [("first|several", LoRA(rank=2))], rngs=nnx.Rngs(1))
    assert nnx.graphdef(net) == structure
    assert (type(net.first), type(net.several[0])) == (nnx.Einsum, nnx.LinearGeneral)
    assert isinstance(model.first, nnx.Einsum)
    assert model.first is model.second
    assert model.first.kernel is not net.first.kernel
    assert nnx.graphdef(lorasp_jax.merge(model)) == structure


def test_attributes_are_set_by_name_in_two_modules():
    """In `paths.put`, and where a layer's own class names its kernel."""
    by_name = re.compile(r"\b(setattr|delattr)\(|\.__class__ =")
    sources = (ROOT / "lorasp_jax").rglob("*.py")
    having = {path.name for path in sources if by_name.search(path.read_text())}
    assert having == {"paths.py", "layers.py"}
