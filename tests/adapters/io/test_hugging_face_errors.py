"""Invalid and unsupported PEFT folders and adapters are rejected with a clear message."""

import numpy as np
import pytest

from lorasp_jax.adapters.io import hugging_face
from lorasp_jax.adapters.io.native import save_adapters
from lorasp_jax.peft import DoRA, FullFineTuning, LoRA, LoRASP
from tests.adapters.io.peft_folder import Net, adapted, edit_config, edit_tensors

BAD_PATTERNS = (
    *("(a+)+b", r"(l)\1", "(?x:#[\n(l+)+#]\n)", "(?#[)(l+)+(?#])"),
    *("l?" * 40, "(l|l)" * 40, ".*l" * 20),
)
"""Patterns that may take forever to match."""


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        *[({"peft_type": kind}, "LORA") for kind in ("LOHA", "ADALORA")],
        ({"lora_bias": True}, "lora_bias"),
        ({"lora_dropout": 1.0}, "dropout must be"),
        ({"use_dora": True}, "lora_magnitude_vector"),
        *[({"lora_alpha": bad}, "lora_alpha") for bad in (None, 0, 1e308, True)],
        *[({name: bad}, name) for name in ("use_rslora", "use_dora") for bad in ("x", 1)],
        *[({"alpha_pattern": bad}, "alpha_pattern") for bad in ({"lin.0": "8"}, 3)],
        *[({"alpha_pattern": {p: 8}}, "alpha_pattern has") for p in BAD_PATTERNS],
        ({"alpha_pattern": {"l(": 8}}, "which is wrong"),
        ({"rank_pattern": {"lin.0": 3}}, "lin.0 has rank 4, but adapter_config.json says 3"),
        *[({"r": bad}, "r must be a number|says") for bad in ("4", 8, True)],
        ({"modules_to_save": ["lin.1"]}, "lacks 'lin.1', which is in its modules_to_save"),
        ({"bias": 0}, "bias"),
        ({"init_lora_weights": "pissa"}, "init_lora_weights"),
    ],
)
def test_unsupported_configs(copy, changes, name):
    if changes == {"peft_type": "ADALORA"}:
        name = "lora_E"  # is missing
    edit_config(copy, **changes)
    with pytest.raises(ValueError, match=name):
        hugging_face.load_peft(copy, Net())


def test_a_config_that_is_no_object(copy):
    for text in ("[]", "null"):
        (copy / hugging_face.CONFIG).write_text(text)
        with pytest.raises(
            ValueError, match=r"adapter_config.json is damaged .it must be an object"
        ):
            hugging_face.load_peft(copy, Net())


def test_pickles_are_never_opened(copy):
    (copy / hugging_face.TENSORS).rename(copy / "adapter_model.bin")
    with pytest.raises(ValueError, match=r"adapter_model.bin, a pickle, .* save it again"):
        hugging_face.load_peft(copy, Net())


def test_folders_of_another_kind(copy, tmp_path):
    with pytest.raises(ValueError, match=f"pass a folder below, as {copy}"):
        hugging_face.load_peft(copy.parent, Net())
    save_adapters(tmp_path / "ours", adapted(("lin/0", LoRA(rank=2))))
    with pytest.raises(ValueError, match="load it with load_adapters"):
        hugging_face.load_peft(tmp_path / "ours", Net())


def renamed(tensors):
    return {name.replace("lin.2", "lin.7"): value for name, value in tensors.items()}


def halved(tensors):
    return {name: value for name, value in tensors.items() if "2.lora_B" not in name}


def narrowed(tensors):
    return {k: v[:, :-1].copy() if "lora_A" in k else v for k, v in tensors.items()}


def extended(tensors):
    return tensors | {"base_model.model.head.weight": np.zeros(3, np.float32)}


def emptied(tensors):
    side = lambda name: np.s_[:0] if "lora_A" in name else np.s_[:, :0]  # noqa: E731
    return {name: np.ascontiguousarray(value[side(name)]) for name, value in tensors.items()}


def doubled(tensors):
    return tensors | {
        name.replace("lora_A", "lora_A.other"): value for name, value in tensors.items()
    }


def flattened(tensors):
    return {name: value.ravel() for name, value in tensors.items()}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (renamed, "'lin.7', .* lin"),
        (halved, "lin.2 .*lora_B"),
        (narrowed, "lin.0 .* 24x40"),
        (extended, "weight of 'head'"),
        (emptied, "lin.0 has rank 0"),
        (doubled, "several tensors for .*lin.0.lora_A"),
        (flattened, "lin.0 must have matrices"),
        (lambda tensors: {}, "no adapters"),
    ],
)
def test_invalid_tensors(copy, change, message):
    edit_tensors(copy, change)
    with pytest.raises(ValueError, match=message):
        hugging_face.load_peft(copy, Net())


def test_magnitudes_fit_the_outputs(tmp_path):
    hugging_face.save_peft(tmp_path, adapted(("lin/0", DoRA(rank=2))))
    name = "base_model.model.lin.0.lora_magnitude_vector"
    for shape in ((4, 10), (39,)):
        edit_tensors(tmp_path, lambda t, shape=shape: t | {name: np.ones(shape, np.float32)})
        with pytest.raises(ValueError, match=r"lin.0 has 40 outputs, a magnitude of \("):
            hugging_face.load_peft(tmp_path, Net())


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ([("lin/0", LoRASP(rank=4))], "lin/0 uses lora_sp"),
        ([("lin/0", LoRA(rank=2, initialization="pissa"))], "lin/0 split"),
        ([("lin/0", LoRA(rank=2)), ("lin/1", DoRA(rank=2))], "use_dora"),
        ([("lin/0", LoRA(rank=2)), ("lin/1", LoRA(rank=2, dropout=0.1))], "lora_dropout"),
        ([("lin/0", LoRA(rank=2)), ("lin/1", LoRASP(rank=4))], "lin/1 uses lora_sp"),
        ([("lin/0", FullFineTuning())], "needs a layer with LoRA"),
        ([], "needs a layer with LoRA"),
    ],
)
def test_unsupported_adapters_are_not_saved(rules, message, tmp_path):
    model = adapted(*rules) if rules else Net()
    with pytest.raises(ValueError, match=message):
        hugging_face.save_peft(tmp_path / "new", model)
    assert not (tmp_path / "new").exists()
