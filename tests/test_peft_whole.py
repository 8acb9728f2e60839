"""What PEFT folders hold beside adapters, biases and whole modules, and folders on the hub."""

import json

import huggingface_hub
import numpy as np
import pytest
import safetensors.numpy
from flax import nnx

from lorasp_jax import adaptation, hugging_face
from lorasp_jax.peft import FullFineTuning, LoRA
from tests.test_hugging_face import FOLDER, GOLDEN, Net


@pytest.mark.parametrize(
    ("name", "trained"),
    [
        ("bias_all", {"lin/0/bias", "lin/1/bias", "lin/2/bias"}),
        ("bias_lora", {"lin/0/bias"}),
        ("head", {"lin/2/bias", "lin/2/kernel"}),
    ],
)
def test_what_peft_trained_in_full(name, trained):
    """bias "all" and "lora_only", modules_to_save; PEFT 0.21.2, dropout 0.1, 20 steps of SGD."""
    arrays = dict(np.load(GOLDEN / "adapter_more_io.npz"))
    model = hugging_face.load_peft(GOLDEN / f"adapter_{name}", Net(arrays))
    np.testing.assert_allclose(model(arrays["x"]), arrays[f"y/{name}"], rtol=0, atol=1e-5)
    methods = adaptation.methods(model)
    assert methods.pop("lin/0") == LoRA(rank=4, alpha=8)
    assert methods == dict.fromkeys(trained, FullFineTuning())


@pytest.mark.parametrize("name", ["bias_all", "bias_lora", "head"])
def test_what_trains_in_full_is_written_again(name, tmp_path):
    folder = GOLDEN / f"adapter_{name}"
    arrays = dict(np.load(GOLDEN / "adapter_more_io.npz"))
    hugging_face.save_peft(tmp_path, hugging_face.load_peft(folder, Net(arrays)))
    folders = (tmp_path, folder)
    ours, theirs = (safetensors.numpy.load_file(f / hugging_face.TENSORS) for f in folders)
    assert ours.keys() == theirs.keys()
    for key, value in theirs.items():
        np.testing.assert_array_equal(ours[key], value)
    ours, theirs = (json.loads((f / hugging_face.CONFIG).read_text()) for f in folders)
    for key in ("bias", "modules_to_save"):
        assert ours[key] == theirs[key]


def test_a_module_that_peft_cannot_hold(tmp_path):
    class Picture(nnx.Module):
        def __init__(self):
            self.conv = nnx.Conv(2, 3, (3,), rngs=nnx.Rngs(0))
            self.head = nnx.Linear(3, 4, rngs=nnx.Rngs(1))

    rules = [("conv", FullFineTuning()), ("head", LoRA(rank=2))]
    model = adaptation.adapt(Picture(), rules, rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="conv/kernel trains in full, which a PEFT folder cannot"):
        hugging_face.save_peft(tmp_path / "new", model)


def test_only_what_is_said_to_be_on_the_hub_is_asked_of_it(monkeypatch):
    asked = []

    def download(name, *, allow_patterns, **options):
        asked.append((name, sorted(allow_patterns)))
        return str(FOLDER)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    model = hugging_face.load_peft("hf://somebody/adapter", Net())
    assert set(adaptation.methods(model)) == {"lin/0", "lin/2"}
    assert asked == [("somebody/adapter", [hugging_face.CONFIG, hugging_face.TENSORS])]
    with pytest.raises(ValueError, match=r"somebody/adapter holds no adapter_config.json"):
        hugging_face.load_peft("somebody/adapter", Net())
    assert len(asked) == 1
