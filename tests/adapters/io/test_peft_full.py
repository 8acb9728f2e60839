"""Fully trained biases and modules in PEFT folders, and folders on the hub."""

import dataclasses
import json
import shutil

import huggingface_hub
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import hugging_face
from lorasp_jax.peft import FullFineTuning, LoRA
from tests import GOLDEN
from tests.adapters.io.peft_folder import FOLDER, Net, edit_config, edit_tensors, reference_net
from tests.models.random_models import with_noise


@pytest.mark.parametrize(
    ("name", "trained"),
    [
        ("bias_all", {"lin/0/bias", "lin/1/bias", "lin/2/bias"}),
        ("bias_lora", {"lin/0/bias"}),
        ("head", {"lin/2/bias", "lin/2/kernel"}),
    ],
)
def test_fully_trained_parameters_of_peft(name, trained):
    """bias "all" and "lora_only", modules_to_save; PEFT 0.21.2, dropout 0.1, 20 steps of SGD."""
    arrays = dict(np.load(GOLDEN / "adapter_more_io.npz"))
    model = hugging_face.load_peft(GOLDEN / f"adapter_{name}", reference_net(arrays))
    np.testing.assert_allclose(model(arrays["x"]), arrays[f"y/{name}"], rtol=0, atol=1e-5)
    methods = adaptation.methods(model)
    assert methods.pop("lin/0") == LoRA(rank=4, alpha=8, dropout=0.1)
    assert methods == dict.fromkeys(trained, FullFineTuning())


@pytest.mark.parametrize("name", ["bias_all", "bias_lora", "head"])
def test_fully_trained_parameters_are_saved(name, tmp_path):
    folder = GOLDEN / f"adapter_{name}"
    arrays = dict(np.load(GOLDEN / "adapter_more_io.npz"))
    hugging_face.save_peft(tmp_path, hugging_face.load_peft(folder, reference_net(arrays)))
    folders = (tmp_path, folder)
    ours, theirs = (safetensors.numpy.load_file(f / hugging_face.TENSORS) for f in folders)
    assert ours.keys() == theirs.keys()
    for key, value in theirs.items():
        np.testing.assert_array_equal(ours[key], value)
    ours, theirs = (json.loads((f / hugging_face.CONFIG).read_text()) for f in folders)
    for key in ("bias", "modules_to_save", "lora_dropout"):
        assert ours[key] == theirs[key]


@pytest.mark.parametrize("bias", ["all", "lora_only"])
def test_missing_biases(bias, tmp_path):
    folder = shutil.copytree(FOLDER, tmp_path / "copy")
    edit_config(folder, bias=bias)
    with pytest.raises(ValueError, match=f"bias '{bias}'"):
        hugging_face.load_peft(folder, Net())
    bare = Net()
    for layer in bare.lin:
        layer.bias, layer.use_bias = None, False
    hugging_face.load_peft(folder, bare)  # without biases, none could have been trained


class Stack(nnx.Module):
    """An embedding, a stack of two layers with norms, a layer with head axes, and a head."""

    def __init__(self, seed=0):
        rngs = nnx.Rngs(seed)
        self.embed = nnx.Embed(7, 6, rngs=rngs)
        make = lambda rngs: nnx.Dict(  # noqa: E731
            norm=nnx.LayerNorm(6, rngs=rngs), lin=nnx.Linear(6, 6, rngs=rngs)
        )
        self.blocks = nnx.vmap(make)(rngs.split(2))
        self.split = nnx.LinearGeneral(6, (2, 3), rngs=rngs)
        self.head = nnx.Linear(6, 4, rngs=rngs)

    def __call__(self, ids):
        run = lambda x, block: x + block["lin"](block["norm"](x))  # noqa: E731
        scan = nnx.scan(run, in_axes=(nnx.Carry, 0), out_axes=nnx.Carry)
        x = self.split(scan(self.embed(ids), self.blocks))
        return self.head(x.reshape(*ids.shape, 6))


def numbered(path, index):
    return ".".join(["model", *map(str, index), *path.split("/")])


def perturbed(model):
    """Add noise to all trainable parameters."""
    graphdef, adapters, frozen = adaptation.split(model)
    return nnx.merge(graphdef, with_noise(adapters, 0.1), frozen)


IDS = jnp.array([[1, 2, 3], [4, 5, 6]])
RULES = {
    "all": [("bias$", FullFineTuning()), ("lin|head", LoRA(rank=2))],
    "modules": [("head|norm|embed", FullFineTuning()), ("lin", LoRA(rank=2))],
    "a stack of dense layers": [("lin", FullFineTuning()), ("head", LoRA(rank=2))],
}


@pytest.mark.parametrize("name", RULES)
def test_round_trip_of_stacks(name, tmp_path):
    """Each layer of a stack is a module, including norms; biases with head axes are flattened."""
    model = perturbed(adaptation.adapt(Stack(), RULES[name], rngs=nnx.Rngs(1)))
    hugging_face.save_peft(tmp_path, model, names=numbered)
    tensors = safetensors.numpy.load_file(tmp_path / hugging_face.TENSORS)
    full_shapes = {k: v.shape for k, v in tensors.items() if "lora" not in k}
    if name == "all":
        assert full_shapes["base_model.model.model.split.bias"] == (6,)
        assert full_shapes["base_model.model.model.1.blocks.norm.bias"] == (6,)
        assert full_shapes["base_model.model.model.0.blocks.lin.base_layer.bias"] == (6,)
    again = hugging_face.load_peft(tmp_path, Stack(), names=numbered)
    np.testing.assert_allclose(again(IDS), model(IDS), rtol=1e-5, atol=1e-5)
    assert adaptation.methods(again).keys() == adaptation.methods(model).keys()
    with pytest.raises(ValueError, match="is a stack"):
        hugging_face.load_peft(tmp_path, Stack())


def test_fully_trained_convolution(tmp_path):
    """torch's [out, in, height, width], with equal sizes but distinct values."""
    base = nnx.Dict(
        conv=nnx.Conv(2, 3, (2, 2), rngs=nnx.Rngs(0)), head=nnx.Linear(3, 4, rngs=nnx.Rngs(1))
    )
    hugging_face.save_peft(
        tmp_path, adaptation.adapt(base, [("head", LoRA(rank=2))], rngs=nnx.Rngs(0))
    )
    kernel = np.arange(24, dtype=np.float32).reshape(3, 2, 2, 2)
    edit_tensors(tmp_path, lambda t: t | {"base_model.model.conv.weight": kernel})
    edit_config(tmp_path, modules_to_save=["conv"])
    loaded_kernel = hugging_face.load_peft(tmp_path, base).conv.kernel.get_value()
    for o, i, h, w in np.ndindex(kernel.shape):
        assert loaded_kernel[h, w, i, o] == kernel[o, i, h, w]


def test_dropout_rates_must_agree(tmp_path):
    rules = [("lin/0", LoRA(rank=2, dropout=0.1)), ("lin/1", LoRA(rank=2))]
    model = adaptation.adapt(Net(), rules, rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="lora_dropout"):
        hugging_face.save_peft(tmp_path / "new", model)
    model.lin[1].method = dataclasses.replace(model.lin[1].method, dropout=0.1)
    hugging_face.save_peft(tmp_path / "new", model)
    again = hugging_face.load_peft(tmp_path / "new", Net())
    assert again.lin[1].method == LoRA(rank=2, alpha=4.0, dropout=0.1)


def test_unsupported_module(tmp_path):
    class ConvNet(nnx.Module):
        def __init__(self):
            self.conv = nnx.Conv(2, 3, (3,), rngs=nnx.Rngs(0))
            self.head = nnx.Linear(3, 4, rngs=nnx.Rngs(1))

    rules = [("conv", FullFineTuning()), ("head", LoRA(rank=2))]
    model = adaptation.adapt(ConvNet(), rules, rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="conv/kernel"):
        hugging_face.save_peft(tmp_path / "new", model)


def test_only_hf_paths_are_downloaded(monkeypatch):
    downloads = []

    def download(name, *, allow_patterns, **options):
        downloads.append((name, sorted(allow_patterns)))
        return str(FOLDER)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    model = hugging_face.load_peft("hf://somebody/adapter", Net())
    assert set(adaptation.methods(model)) == {"lin/0", "lin/2"}
    assert downloads == [("somebody/adapter", [hugging_face.CONFIG, hugging_face.TENSORS])]
    with pytest.raises(ValueError, match=r"adapter_config.json"):
        hugging_face.load_peft("somebody/adapter", Net())
    assert len(downloads) == 1
