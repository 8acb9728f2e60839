"""Read and validate a Hugging Face PEFT folder, as arrays by module.

Type checks cover the fields of `LoraConfig` and `AdaLoraConfig` of PEFT 0.21.2 that have a simple
JSON type. A wrong type is rejected even if Python could use the value: the string "false" would
count as true. Fields may be null or absent, except `peft_type` and those that determine an
adapter's scale.
"""

import collections
import json
import math
import pathlib
import re
import reprlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from lorasp_jax.adapters.io.name_patterns import values_of
from lorasp_jax.adapters.io.native import read_bytes, read_tensors
from lorasp_jax.peft.fields import short
from lorasp_jax.peft.method import MAX_ALPHA, MAX_SIZE

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

Adapter = dict[str, np.ndarray]
FullTensors = dict[tuple[str, str], np.ndarray]
"""Fully trained parameters by (module, "weight" or "bias"), in torch's layout."""


def read_folder(folder: pathlib.Path) -> tuple[dict[str, Any], dict[str, Adapter], FullTensors]:
    """Read the config, the adapters by module in this project's layout, and the `FullTensors`.

    Raises:
      ValueError: files are missing or damaged, or the adapter is not supported.
    """
    for name in (CONFIG, TENSORS):
        if not (folder / name).is_file():
            raise ValueError(f"{folder} has no {name}; a PEFT adapter needs {CONFIG} and {TENSORS}")
    try:
        config = json.loads(read_bytes(folder / CONFIG))
        kind = config["peft_type"]
        _check_fields(config)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{folder / CONFIG} is damaged or not a PEFT config: {error}") from error
    tensors = read_tensors(folder / TENSORS, read_bytes(folder / TENSORS))
    _check_supported(folder, kind, config)
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
    try:
        alphas = values_of(config.get("alpha_pattern") or {}, modules, config.get("lora_alpha"))
        imported = {
            name: _from_peft(config, name, tensors, alphas[name])
            for name, tensors in modules.items()
        }
        return config, imported, full_values
    except (ValueError, TypeError, LookupError, ArithmeticError, RecursionError) as error:
        raise ValueError(f"{folder} is not a valid PEFT adapter: {error}") from error


def _check_supported(folder: pathlib.Path, kind: object, config: Mapping[str, Any]) -> None:
    """Raise ValueError if a PEFT config needs a feature that this project lacks."""
    if kind not in ("LORA", "ADALORA"):
        raise ValueError(
            f"{folder} has peft_type {str(kind)[:40]}; only LORA and ADALORA are supported"
        )
    if enabled := [name for name in _UNSUPPORTED if config.get(name) not in _DISABLED]:
        raise ValueError(
            f"{folder} sets {enabled[0]} to {reprlib.repr(config[enabled[0]])}, which is not "
            "supported: merge the adapter in PEFT (merge_and_unload), and load the result"
        )
    if (initialization := config.get("init_lora_weights")) not in _BASE_PRESERVING:
        raise ValueError(
            f"the adapter in {folder} was trained on the residual base of "
            f"{reprlib.repr(initialization)}: convert it to plain LoRA with PEFT's "
            "path_initial_model_for_weight_conversion"
        )


def _is_fully_trained(config: Mapping[str, Any], module: str, kind: str) -> bool:
    """Whether the config allows a fully trained weight or bias of the module."""
    saved = any(f".{name}." in f".{module}." for name in config.get("modules_to_save") or ())
    return saved or (kind == "bias" and config.get("bias") in ("all", "lora_only"))


def _from_peft(config: Mapping[str, Any], module: str, tensors: Adapter, alpha: Any) -> Adapter:
    """Convert a module's tensors to lora_a, lora_b, scale and, for DoRA, magnitude."""
    ada = config["peft_type"] == "ADALORA"
    expected = {"lora_A", "lora_B"} | ({"lora_E"} if ada else set())
    expected |= {"lora_magnitude_vector"} if config.get("use_dora") else set()
    if missing := expected - tensors.keys():
        raise ValueError(f"the adapter of {module} lacks {min(missing)}")
    if unexpected := tensors.keys() - expected:
        raise ValueError(f"the adapter of {module} has an unexpected {min(unexpected)}")
    a, b = tensors["lora_A"].T, tensors["lora_B"].T
    if not alpha or (ada and not config.get("init_r")):
        raise ValueError(f"the adapter of {module} lacks lora_alpha or init_r for its scale")
    if ada:
        scale = alpha / (config["init_r"] + _ADA_CONSTANT)
        a = a * tensors["lora_E"][:, 0]
    else:
        rank = a.shape[1]
        scale = alpha / (math.sqrt(rank) if config.get("use_rslora") else rank)
    if not math.isfinite(scale):
        raise ValueError(f"the scale of the adapter of {module} must be finite, got {scale}")
    adapter = {"lora_a": a, "lora_b": b, "scale": np.float32(scale)}
    if "lora_magnitude_vector" in tensors:
        adapter["magnitude"] = tensors["lora_magnitude_vector"].reshape(-1)
    return adapter


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and type(value) is not bool and abs(value) < math.inf


def _is_alpha(value: Any) -> bool:
    return _is_number(value) and 1 / MAX_ALPHA <= abs(value) <= MAX_ALPHA


def _is_size(value: Any) -> bool:
    return type(value) is int and 1 <= value <= MAX_SIZE


def _is_string_list(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


_FIELD_TYPES: dict[str, tuple[Callable[[Any], bool], tuple[str, ...]]] = {
    "true or false": (
        lambda value: type(value) is bool,
        ("use_dora", "use_rslora", "use_qalora", "fan_in_fan_out", "inference_mode", "lora_bias"),
    ),
    f"a number other than 0, up to {MAX_ALPHA:g}": (_is_alpha, ("lora_alpha",)),
    "an object of non-zero numbers": (
        lambda value: isinstance(value, dict) and all(map(_is_alpha, value.values())),
        ("alpha_pattern",),
    ),
    f"an integer from 1 to {MAX_SIZE}": (_is_size, ("r", "init_r", "target_r")),
    "a number in [0, 1)": (
        lambda value: _is_number(value) and 0 <= value < 1,
        ("lora_dropout",),
    ),
    "a string": (
        lambda value: isinstance(value, str),
        ("peft_type", "base_model_name_or_path", "revision", "task_type"),
    ),
    "'none', 'all' or 'lora_only'": (
        lambda value: value in ("none", "all", "lora_only"),
        ("bias",),
    ),
    "a string or a list of strings": (
        lambda value: isinstance(value, str) or _is_string_list(value),
        ("target_modules", "exclude_modules", "layers_pattern"),
    ),
    "a list of strings": (_is_string_list, ("modules_to_save", "target_parameters")),
    "true, false or a string": (
        lambda value: type(value) is bool or isinstance(value, str),
        ("init_lora_weights",),
    ),
    "an object": (lambda value: isinstance(value, dict), ("rank_pattern", "loftq_config")),
}


def _check_fields(config: Mapping[str, Any]) -> None:
    """Raise ValueError for a field of the wrong type or out of range."""
    for description, (is_valid, names) in _FIELD_TYPES.items():
        for name in names:
            value = config.get(name)
            if value is not None and not is_valid(value):
                raise ValueError(f"{name} must be {description}, got {reprlib.repr(value)}")
