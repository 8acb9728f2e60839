"""Exchange adapter folders with Hugging Face PEFT itself, in an environment of its own."""

import shutil

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import hugging_face
from lorasp_jax.dense import AdaptedLayer
from lorasp_jax.peft import AdaLoRA, DoRA, FullFineTuning, LoRA
from tests import ROOT, foreign
from tests.adapters.io.peft_folder import reference_net, trained

pytestmark = pytest.mark.slow

SCRIPT = ROOT / "tests" / "adapters" / "io" / "peft_script.py"
RANKS = {
    "lora": [4, 4],
    "rslora": [4, 4],
    "dora": [4, 4],
    "dora_rslora": [4, 4],
    "adalora": None,  # as PEFT allocates
    "patterns": [2, 7, 4],
    "patterns_rslora": [4, 9],
    "regular_expression": [8],
    "gaussian": [4, 4],
    "bias_all": [4, 4],
    "bias_lora_only": [4, 4],
    "modules_to_save": [3],
    "end_of_a_name": [3],
    "lookahead": [4, 4],
    "pissa": [8, 8],  # twice PEFT's rank, as an update of the original base
    "olora": [8, 8],
}
"""Folders that PEFT writes, and the ranks of their layers."""
REFUSED = {
    "loha": "has peft_type LOHA; only LORA and ADALORA are supported",
    "ia3": "has peft_type IA3; only LORA and ADALORA are supported",
    "lora_bias": "sets lora_bias to True, which is not supported: merge the adapter in PEFT",
}
RULES = {
    "lora": [("lin/[02]", LoRA(rank=4, alpha=3.0))],
    "rslora": [(".*", LoRA(rank=4, alpha=1.0, rank_stabilized=True))],
    "dora": [("lin/[02]", DoRA(rank=3))],
    "dropout": [(".*", LoRA(rank=4, dropout=0.5))],
    "adalora": [(".*", AdaLoRA(rank=6))],
    "patterns": [("lin/1", LoRA(rank=9, alpha=2.0)), ("lin/2", AdaLoRA(rank=5)), (".*", LoRA(2))],
    "bias_all": [("bias$", FullFineTuning()), ("lin/0", LoRA(rank=2))],
    "bias_lora_only": [("lin/0/bias", FullFineTuning()), ("lin/0", LoRA(rank=2))],
    "head": [("lin/2", FullFineTuning()), (".*", LoRA(rank=4))],
}
"""Folders that this project writes."""


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Folders of both, written and read by PEFT: `theirs` and `ours`."""
    folder = tmp_path_factory.mktemp("peft")
    theirs, ours = folder / "theirs", folder / "ours"
    with foreign.environment("peft==0.21.2", "torch==2.13.0", "transformers==5.23.0") as python:
        foreign.run(python, SCRIPT, "write", theirs)
        ours.mkdir()
        shutil.copy(theirs / "base.npz", ours)
        for name in RULES:
            hugging_face.save_peft(ours / name, adapted(base(theirs), name))
        foreign.run(python, SCRIPT, "read", ours)
    return {"theirs": theirs, "ours": ours}


def arrays(file):
    with np.load(file) as stored:
        return dict(stored)


def base(folder):
    return reference_net(arrays(folder / "base.npz"))


def adapted(net, name):
    """Adapt with the rules of a name, as trained, with two of AdaLoRA's directions pruned."""
    model = trained(adaptation.adapt(net, RULES[name], rngs=nnx.Rngs(1)))
    for _, layer in nnx.iter_graph(model):
        if isinstance(layer, AdaptedLayer) and isinstance(layer.method, AdaLoRA):
            values = dict(layer.adapter.get_value())
            layer.adapter.set_value(
                values | {"lora_e": values["lora_e"].at[jnp.array([0, 3])].set(0)}
            )
    return model


def assert_different(a, b):
    assert np.abs(a - b).max() > 0.1, "the adapter does nothing"


@pytest.mark.parametrize("name", RANKS)
def test_folders_of_peft(folders, name):
    folder = folders["theirs"]
    net, x, y = (
        base(folder),
        arrays(folder / "base.npz")["x"],
        arrays(folder / f"{name}.npz")["y"],
    )
    model = hugging_face.load_peft(folder / name, net)
    assert_different(y, net(x))
    np.testing.assert_allclose(model(x), y, rtol=1e-6, atol=2e-6)
    np.testing.assert_allclose(lorasp_jax.merge(model)(x), y, rtol=0, atol=1e-5)
    methods = adaptation.methods(model)
    ranks = [method.rank for path, method in sorted(methods.items()) if not method.trains_base]
    assert ranks == RANKS[name] or (name == "adalora" and 0 < sum(ranks) < 12)


@pytest.mark.parametrize("name", REFUSED)
def test_folders_of_peft_that_are_refused(folders, name):
    with pytest.raises(ValueError, match=REFUSED[name]):
        hugging_face.load_peft(folders["theirs"] / name, base(folders["theirs"]))


@pytest.mark.parametrize("name", RULES)
def test_peft_reads_folders_of_this_project(folders, name):
    folder = folders["ours"]
    net, x = base(folder), arrays(folder / "base.npz")["x"]
    expected, results = adapted(net, name)(x), arrays(folder / f"{name}.npz")
    assert_different(expected, net(x))
    np.testing.assert_allclose(results["y"], expected, rtol=1e-6, atol=2e-6)
    np.testing.assert_allclose(results["merged"], expected, rtol=0, atol=1e-5)
