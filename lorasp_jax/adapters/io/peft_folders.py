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
from collections.abc import Mapping
from typing import Any

import numpy as np

from lorasp_jax.adapters.io.native import read_tensors
from lorasp_jax.base import json_values
from lorasp_jax.base.files import RefusedError, as_value_error, read_json
from lorasp_jax.peft.fields import short

CONFIG, TENSORS = "adapter_config.json", "adapter_model.safetensors"
PREFIX = "base_model.model."
_TENSOR = re.compile(
    rf"{re.escape(PREFIX)}(.+)\.(lora_A|lora_B|lora_E|lora_magnitude_vector)(\.weight)?"
)
_FULL_TENSOR = re.compile(rf"{re.escape(PREFIX)}(.+?)(\.base_layer)?\.(weight|bias)")
_ADA_CONSTANT = 1e-5  # AdaLoRA's scale is α/(init_r + this)
# Initializations that do not change the base. With others (PiSSA, OLoRA, CorDA, LoRA-GA, LoftQ), A
# and B fit only the residual base.
_BASE_PRESERVING = (None, True, False, "gaussian", "orthogonal", "eva", "mica")
# Fields that are not supported, and the values that disable them.
_DISABLED = (None, False, [], {}, "none")
_UNSUPPORTED = (
    "lora_bias", "fan_in_fan_out", "layer_replication", "use_qalora", "target_parameters",
    "trainable_token_indices", "use_bdlora", "alora_invocation_tokens",
)  # fmt: skip
# Schema of the fields that this module interprets, see `json_values.check`.
_FIELDS: dict[str, Any] = {
    "peft_type": str,
    "use_dora?": bool,
    "use_rslora?": bool,
    "lora_alpha?": float,
    "alpha_pattern?": {str: float},
    "init_r?": int,
    "lora_dropout?": float,
    "bias?": str,
    "modules_to_save?": [str],
}

Adapter = dict[str, np.ndarray]
FullTensors = dict[tuple[str, str], np.ndarray]
"""Fully trained parameters by (module, "weight" or "bias"), in torch's layout."""


def read_folder(folder: pathlib.Path) -> tuple[dict[str, Any], dict[str, Adapter], FullTensors]:
    """Read the config, the adapters by module in this project's layout, and the `FullTensors`.

    Raises:
        ValueError: files are missing or damaged, or the adapter is not supported.
    """
    with as_value_error(folder / CONFIG):
        config = read_json(folder / CONFIG)
        json_values.check({name: v for name, v in config.items() if v is not None}, _FIELDS)
        if config.get("bias") not in (None, "none", "all", "lora_only"):
            raise ValueError(f"bias must be 'none', 'all' or 'lora_only', got {config['bias']!r}")
    _, tensors = read_tensors(folder / TENSORS)
    _check_supported(folder, config)
    modules, full_values = collections.defaultdict(dict), {}
    for name, tensor in tensors.items():
        if match := _TENSOR.fullmatch(name):
            modules[match[1]][match[2]] = tensor.astype(np.float32)
        elif (match := _FULL_TENSOR.fullmatch(name)) and _is_fully_trained(
            config, match[1], match[3]
        ):
            full_values[match[1], match[3]] = tensor.astype(np.float32)
        else:
            raise ValueError(f"{folder} has the unexpected tensor {short(name)}")
    with as_value_error(folder, re.error):
        imported = {name: _from_peft(config, name, tensors) for name, tensors in modules.items()}
    return config, imported, full_values


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
    """Whether the config allows a fully trained weight or bias of the module."""
    saved = any(f".{name}." in f".{module}." for name in config.get("modules_to_save") or ())
    return saved or (kind == "bias" and config.get("bias") in ("all", "lora_only"))


def _from_peft(config: Mapping[str, Any], module: str, tensors: Adapter) -> Adapter:
    """Convert a module's tensors to lora_a, lora_b, scale and, for DoRA, magnitude."""
    ada = config["peft_type"] == "ADALORA"
    expected = {"lora_A", "lora_B"} | ({"lora_E"} if ada else set())
    expected |= {"lora_magnitude_vector"} if config.get("use_dora") else set()
    if expected != tensors.keys():
        raise ValueError(f"{module} must have {sorted(expected)}, got {sorted(tensors)}")
    a, b, alpha = tensors["lora_A"].T, tensors["lora_B"].T, _alpha(config, module)
    if not alpha or (ada and (config.get("init_r") or 0) < 1):
        raise ValueError(f"{module} lacks lora_alpha or init_r for its scale")
    if ada:
        scale = alpha / (config["init_r"] + _ADA_CONSTANT)
        a = a * tensors["lora_E"][:, 0]
    else:
        rank = a.shape[1]
        scale = alpha / (math.sqrt(rank) if config.get("use_rslora") else rank)
    adapter = {"lora_a": a, "lora_b": b, "scale": np.float32(scale)}
    if "lora_magnitude_vector" in tensors:
        adapter["magnitude"] = tensors["lora_magnitude_vector"].reshape(-1)
    return adapter


def _alpha(config: Mapping[str, Any], module: str) -> Any:
    """α of a module: that of the first pattern that matches its name or a suffix after a dot.

    As in PEFT (get_pattern_key of 0.21.2), but without repetitions except a leading ".*": a pattern
    such as (a+)+b may take forever to match.
    """
    for pattern, alpha in (config.get("alpha_pattern") or {}).items():
        if not re.fullmatch(r"(\.\*)?([\w.^$()\[\]|-]|\\\D)*", pattern):
            raise RefusedError(
                f"alpha_pattern has {short(pattern)}: a pattern with repetitions is not supported"
            )
        if re.match(rf"(.*\.)?({pattern})$", module):
            return alpha
    return config.get("lora_alpha")
