"""Invalid and unsupported PEFT folders and adapters are rejected with a clear message."""

import os

import numpy as np
import pytest

from lorasp_jax.adapters.io import hugging_face
from lorasp_jax.peft import DoRA, LoRA, LoRASP
from tests.adapters.io.peft_folder import Net, adapted, edit_config, edit_tensors


def test_catastrophic_patterns_are_rejected(copy):
    """The module is named to trigger the backtracking."""
    edit_tensors(copy, lambda t: {n.replace("lin.0", "a" * 60): v for n, v in t.items()})
    edit_config(copy, alpha_pattern={"(a+)+b": 8})
    with pytest.raises(ValueError, match=r"the pattern '\(a\+\)\+b' could take too long"):
        hugging_face.load_peft(copy, Net())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"peft_type": "LOHA"}, "has peft_type LOHA; only LORA and ADALORA"),
        ({"lora_bias": True}, "sets lora_bias to True, which is not supported: merge the adapter"),
        ({"lora_dropout": 1.0}, r"lora_dropout must be a number in \[0, 1\), got 1.0"),
        ({"use_dora": True}, "adapter of lin.0 lacks lora_magnitude_vector"),
        ({"peft_type": "ADALORA"}, "adapter of lin.0 lacks lora_E"),
        ({"lora_alpha": None}, "lacks lora_alpha or init_r for its scale"),
        ({"lora_alpha": 0}, "lora_alpha must be a number other than 0"),
        ({"lora_alpha": 1e308}, "lora_alpha must be a number other than 0"),
        ({"lora_alpha": True}, "lora_alpha must be a number"),
        ({"use_rslora": "x"}, "use_rslora must be true or false, got 'x'"),
        ({"use_dora": 1}, "use_dora must be true or false, got 1"),
        ({"alpha_pattern": {"lin.0": "8"}}, "alpha_pattern must be an object of non-zero numbers"),
        ({"alpha_pattern": {"l(": 8}}, r"'l\(' is not a valid regular expression"),
        ({"r": 8.5}, "r must be an integer from 1"),
        ({"target_modules": 3}, "target_modules must be a string or a list of strings"),
        ({"bias": 0}, "bias must be 'none', 'all' or 'lora_only', got 0"),
        ({"init_lora_weights": "pissa"}, "trained on the residual base of 'pissa'"),
    ],
)
def test_unsupported_configs(copy, changes, message):
    edit_config(copy, **changes)
    with pytest.raises(ValueError, match=message):
        hugging_face.load_peft(copy, Net())


def renamed(tensors):
    return {name.replace("lin.2", "lin.7"): value for name, value in tensors.items()}


def halved(tensors):
    return {name: value for name, value in tensors.items() if "2.lora_B" not in name}


def narrowed(tensors):
    return {k: v[:, :-1].copy() if "lora_A" in k else v for k, v in tensors.items()}


def extended(tensors):
    return tensors | {"base_model.model.head.weight": np.zeros(3, np.float32)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (renamed, r"adapts 'lin.7', which the model lacks; the model has lin"),
        (halved, "adapter of lin.2 lacks lora_B"),
        (narrowed, r"shapes \(23, 4\) and \(4, 40\) of lin.0 do not match the 24x40 kernel"),
        (extended, "has the unexpected tensor .*head.weight'"),
        (lambda tensors: {}, "contains no adapters"),
    ],
)
def test_invalid_tensors(copy, change, message):
    edit_tensors(copy, change)
    with pytest.raises(ValueError, match=message):
        hugging_face.load_peft(copy, Net())


@pytest.mark.parametrize("name", [hugging_face.CONFIG, hugging_face.TENSORS])
def test_damaged_and_missing_files(copy, name):
    (copy / name).write_bytes(b"{")
    with pytest.raises(ValueError, match=f"{name} is damaged or not"):
        hugging_face.load_peft(copy, Net())
    (copy / name).unlink()
    with pytest.raises(ValueError, match=f"has no {name}"):
        hugging_face.load_peft(copy, Net())


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ([("lin/0", LoRASP(rank=4))], "lin/0 uses lora_sp, which Hugging Face PEFT does not"),
        ([("lin/0", LoRA(rank=2, initialization="pissa"))], "split the kernel, so it cannot"),
        ([("lin/0", LoRA(rank=2)), ("lin/1", DoRA(rank=2))], "cannot mix LoRA and DoRA"),
        ([], "at least one adapter"),
    ],
)
def test_unsupported_adapters_are_not_saved(rules, message, tmp_path):
    model = adapted(*rules) if rules else Net()
    with pytest.raises(ValueError, match=message):
        hugging_face.save_peft(tmp_path / "new", model)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("name", ["adapter_config.json", "adapter_model.safetensors"])
def test_files_larger_than_memory(copy, name):
    os.truncate(copy / name, 2**43)
    with pytest.raises(ValueError, match=f"{name} has 8796093022208 bytes, more than"):
        hugging_face.load_peft(copy, Net())
