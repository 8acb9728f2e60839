"""Read and validate a Hugging Face PEFT folder, as arrays by module.

Fields are those of `LoraConfig` and `AdaLoraConfig` of PEFT 0.21.2. A wrong type is rejected even
if Python could use the value: the string "false" would count as true. Fields may be null or absent,
except `peft_type` and those that determine an adapter's scale.
"""

import collections
import math
import pathlib
import re
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from lorasp_jax.adapters import paths
from lorasp_jax.adapters.io.native import DESCRIPTION, read_tensors
from lorasp_jax.base import json_values
from lorasp_jax.base.files import as_value_error, read_json
from lorasp_jax.peft.fields import short

CONFIG, TENSORS = "adapter_config.json", "adapter_model.safetensors"
PICKLE = "adapter_model.bin"
PREFIX = "base_model.model."
# A state dict that PEFT did not save itself still has the adapter's name in its keys.
_TENSOR = re.compile(
    rf"{re.escape(PREFIX)}(?P<module>.+)\.lora_(?:embedding_)?"
    r"(?P<part>[ABE]|magnitude_vector)(?:\.(?!weight$)(?P<adapter>[^.]+))?(?:\.weight)?"
)
_BASE_TENSOR = re.compile(rf"{re.escape(PREFIX)}(.+?)(\.base_layer)?\.(weight|bias)")
_ADA_CONSTANT = 1e-5  # AdaLoRA's scale is α/(init_r + this)
_STEPS = 1e9  # at most as many to match a pattern; about a hundredth of them are taken
# Initializations that do not change the base. With others (PiSSA, OLoRA, CorDA, LoRA-GA, LoftQ), A
# and B fit only the residual base.
_BASE_PRESERVING = (None, True, False, "gaussian", "orthogonal", "eva", "mica")
# Fields that are not supported, and the values that disable them.
_DISABLED = (None, False, [], {}, "none")
_UNSUPPORTED = (
    "lora_bias", "fan_in_fan_out", "layer_replication", "use_qalora", "target_parameters",
    "trainable_token_indices", "use_bdlora", "alora_invocation_tokens", "arrow_config",
    "kasa_config", "monteclora_config",
)  # fmt: skip
# Schema of the fields that this module interprets, see `json_values.check`.
_FIELDS: dict[str, Any] = {
    "peft_type": str,
    "use_dora?": bool,
    "use_rslora?": bool,
    "r?": float,
    "rank_pattern?": {},
    "lora_alpha?": float,
    "alpha_pattern?": {str: float},
    "init_r?": int,
    "lora_dropout?": float,
    "bias?": str,
    "modules_to_save?": [str],
}

Adapter = dict[str, np.ndarray]
FullTensors = dict[tuple[str, str], np.ndarray]
"""Weights and biases by (module, "weight" or "bias"), in torch's layout."""


class PeftFolder(NamedTuple):
    """Contents of a PEFT folder.

    Attributes:
        config: fields of adapter_config.json.
        adapters: by module, in this project's layout.
        trained: fully trained parameters.
        base: frozen parameters of the base, with which PEFT replaces those of the model. It stores
            embeddings and output layers that it adapts, or that were resized.
    """

    config: dict[str, Any]
    adapters: dict[str, Adapter]
    trained: FullTensors
    base: FullTensors


def read_folder(folder: pathlib.Path) -> PeftFolder:
    """Read a PEFT folder.

    Raises:
        ValueError: files are missing or damaged, or the adapter is not supported.
    """
    _refuse_other_folders(folder)
    with as_value_error(folder / CONFIG):
        config = read_json(folder / CONFIG)
        json_values.check(config, _FIELDS, nulls=True)
        if config.get("bias") not in (None, "none", "all", "lora_only"):
            raise ValueError(f"bias must be 'none', 'all' or 'lora_only', got {config['bias']!r}")
    _, tensors = read_tensors(folder / TENSORS)
    _check_supported(folder, config)
    modules, trained, base = collections.defaultdict(dict), {}, {}
    adapter_names = set()
    for name, tensor in tensors.items():
        if match := _TENSOR.fullmatch(name):
            values, key = modules[match["module"]], f"lora_{match['part']}"
            adapter_names.add(match["adapter"])
        elif match := _BASE_TENSOR.fullmatch(name):
            values = trained if _is_fully_trained(config, match[1], match[3]) else base
            key = match[1], match[3]
        else:
            raise ValueError(f"{folder} has the unexpected tensor {short(name)}")
        if key in values or len(adapter_names) > 1:
            what = "tensors" if key in values else "adapters"
            raise ValueError(f"{folder} has several {what} for {short(name)}: save one adapter")
        values[key] = tensor.astype(np.float32)
    with paths.naming("load", folder):
        adapters = {name: _from_peft(config, name, tensors) for name, tensors in modules.items()}
    return PeftFolder(config, adapters, trained, base)


def _refuse_other_folders(folder: pathlib.Path) -> None:
    """Raise ValueError for a folder of `save_adapters`, one above a PEFT folder, or a pickle."""
    if (folder / CONFIG).exists():
        if (folder / PICKLE).exists() and not (folder / TENSORS).exists():
            raise ValueError(
                f"{folder} has its tensors in {PICKLE}, a pickle, which is never opened: load it "
                f"in PEFT and save it again, which writes {TENSORS}"
            )
        return
    if (folder / DESCRIPTION).exists():
        raise ValueError(f"{folder} is a folder of save_adapters: load it with load_adapters")
    if below := sorted(folder.glob(f"*/{CONFIG}")):
        raise ValueError(f"{folder} lacks {CONFIG}: pass a folder below, as {below[-1].parent}")


def _check_supported(folder: pathlib.Path, config: Mapping[str, Any]) -> None:
    """Raise ValueError if a PEFT config needs a feature that this project lacks."""
    if (kind := config["peft_type"]) not in ("LORA", "ADALORA"):
        raise ValueError(f"{folder} has peft_type {kind}; only LORA and ADALORA are supported")
    enabled = [name for name in _UNSUPPORTED if config.get(name) not in _DISABLED]
    if config.get("init_lora_weights") not in _BASE_PRESERVING:
        enabled.append("init_lora_weights")
    if enabled:
        raise ValueError(
            f"{folder} sets {enabled[0]} to {reprlib.repr(config[enabled[0]])}, which is not "
            "supported: merge the adapter in PEFT (merge_and_unload), and load the result"
        )


def _is_fully_trained(config: Mapping[str, Any], module: str, kind: str) -> bool:
    """Whether the config says that a weight or bias of the module was fully trained."""
    trains_bias = kind == "bias" and config.get("bias") in ("all", "lora_only")
    return trains_bias or is_saved(config.get("modules_to_save") or (), module)


def is_saved(entries: Sequence[str], module: str) -> bool:
    """Whether the entries of modules_to_save comprise a module.

    As in PEFT (_set_trainable of 0.21.2), an entry is the end of a name, also in the middle of a
    word, and comprises the modules inside.
    """
    ends = (dot.start() for dot in re.finditer(r"\.|$", module))
    return any(module[:end].endswith(tuple(entries)) for end in ends)


def _from_peft(config: Mapping[str, Any], module: str, tensors: Adapter) -> Adapter:
    """Convert a module's tensors to lora_a, lora_b, scale and, for DoRA, magnitude."""
    ada = config["peft_type"] == "ADALORA"
    expected = {"lora_A", "lora_B"} | ({"lora_E"} if ada else set())
    expected |= {"lora_magnitude_vector"} if config.get("use_dora") else set()
    if expected != tensors.keys():
        raise ValueError(f"{module} must have {sorted(expected)}, got {sorted(tensors)}")
    if not (alpha := _by_pattern(config, "alpha_pattern", "lora_alpha", module)):
        raise ValueError(f"{module} needs a lora_alpha other than 0 for its scale, got {alpha}")
    if not ada and not len(tensors["lora_A"]):
        raise ValueError(f"{module} has rank 0, but a rank must be at least 1")
    a, b = _matrix(module, tensors["lora_A"]), _matrix(module, tensors["lora_B"])
    if ada:
        if (first := config.get("init_r") or 0) < 1:
            raise ValueError(f"{module} needs an init_r of at least 1 for its scale, got {first}")
        scale = alpha / (first + _ADA_CONSTANT)
        e = _matrix(module, tensors["lora_E"])
        if e.shape != (1, a.shape[1]):
            raise ValueError(f"{module} has {e.shape} singular values for rank {a.shape[1]}")
        a = a * e
    else:
        rank = a.shape[1]
        if (expected_rank := _by_pattern(config, "rank_pattern", "r", module)) not in (None, rank):
            raise ValueError(f"{module} has rank {rank}, but {CONFIG} says {expected_rank}")
        scale = alpha / (math.sqrt(rank) if config.get("use_rslora") else rank)
    adapter = {"lora_a": a, "lora_b": b, "scale": np.float32(scale)}
    if "lora_magnitude_vector" in tensors:
        magnitude, outputs = tensors["lora_magnitude_vector"], b.shape[1]
        if magnitude.size != outputs or outputs not in magnitude.shape:
            raise ValueError(f"{module} has {outputs} outputs, a magnitude of {magnitude.shape}")
        adapter["magnitude"] = magnitude.reshape(-1)
    return adapter


def _matrix(module: str, tensor: np.ndarray) -> np.ndarray:
    """Convert A to `[sizes · I, R]` or B to `[R, O]`; only those of a convolution have sizes."""
    if tensor.ndim < 2:
        raise ValueError(f"{module} must have matrices, got a tensor of shape {tensor.shape}")
    kernel = from_torch(tensor)
    return kernel.reshape(math.prod(kernel.shape[:-1]), kernel.shape[-1])


def from_torch(kernel: np.ndarray) -> np.ndarray:
    """Convert torch's `[out, in, *sizes]` to `[*sizes, I, O]`; sizes are those of a convolution."""
    return kernel.transpose(*range(2, kernel.ndim), 1, 0)


def to_torch(kernel: np.ndarray) -> np.ndarray:
    """Inverse of `from_torch`."""
    return np.ascontiguousarray(kernel.transpose(-1, -2, *range(kernel.ndim - 2)))


def _by_pattern(config: Mapping[str, Any], field: str, default: str, module: str) -> Any:
    """α or rank of a module: that of the first pattern that matches its name's end after a dot.

    As in PEFT (get_pattern_key of 0.21.2), whose AdaLoRA has no such patterns.
    """
    patterns = config.get(field) or {} if config["peft_type"] == "LORA" else {}
    for pattern, value in patterns.items():
        _check_cost(field, pattern, module)
        try:
            if re.match(rf"(.*\.)?({pattern})$", module):
                return value
        except (re.error, RecursionError, OverflowError) as error:
            raise ValueError(f"{field} has {short(pattern)}, which is wrong: {error}") from error
    return config.get(default)


def _check_cost(field: str, pattern: str, module: str) -> None:
    """Raise ValueError if matching an untrusted pattern could take forever, as (a+)+b does.

    Without repeated groups and back references, each repetition has at most as many ends as the
    name has characters, and each group as many as it has alternatives.
    """
    plain = re.sub(r"\\\D|\[\^?\]?[^]]*\]", "x", pattern)
    repetitions = len(re.findall(r"(?<!\()[*+?{]", plain))
    groups, bars = plain.count("(") + 1, plain.count("|")
    cost = math.log(len(module)) * (1 + repetitions) + math.log(bars / groups + 1) * groups
    if re.search(r"\)[*+{]|\\|\(\?(?!<?[=!]|:)", plain) or cost > math.log(_STEPS):
        raise ValueError(
            f"{field} has {short(pattern)}: repeated groups, back references, named groups, "
            "flags and many repetitions are not supported, as they may take forever to match"
        )
