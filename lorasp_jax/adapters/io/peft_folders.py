"""A folder of Hugging Face PEFT as arrays by module, once everything in it has been checked.

The fields that are checked by type are those of `LoraConfig` and `AdaLoraConfig` of PEFT 0.21.2
that JSON holds as one plain type. All may be null or left out, but for what scales an adapter. A
field of another type would mean something else to each reader: "use_rslora": "false" is true to
Python.
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
from lorasp_jax.adapters.io.native import read_tensors, read_whole
from lorasp_jax.peft._fields import short
from lorasp_jax.peft._method import MAX_ALPHA, MAX_SIZE

CONFIG, TENSORS = "adapter_config.json", "adapter_model.safetensors"
PREFIX = "base_model.model."
_TENSOR = re.compile(
    rf"{re.escape(PREFIX)}(.+)\.(lora_A|lora_B|lora_E|lora_magnitude_vector)(\.weight)?"
)
_WHOLE = re.compile(rf"{re.escape(PREFIX)}(.+?)(\.base_layer)?\.(weight|bias)")
_ADA_CONSTANT = 1e-5  # AdaLoRA's scale is α/(r + this)
# What a folder may ask for beyond its tensors, and the values that ask for nothing.
_NOTHING = (None, False, [], {}, "none")
# Initialisations that leave the base as it is. After the others (PiSSA, OLoRA, CorDA, LoRA-GA,
# LoftQ) A and B belong to what was left of the base.
_WHOLE_BASE = (None, True, False, "gaussian", "orthogonal", "eva", "mica")
_UNKNOWN = (
    "lora_bias", "fan_in_fan_out", "layer_replication", "use_qalora", "target_parameters",
    "trainable_token_indices", "use_bdlora", "alora_invocation_tokens",
)  # fmt: skip

Adapter = dict[str, np.ndarray]
Whole = dict[tuple[str, str], np.ndarray]
"""What trains in full, by module and "weight" or "bias", in torch's layout."""


def read(folder: pathlib.Path) -> tuple[dict[str, Any], dict[str, Adapter], Whole]:
    """The configuration, by module lora_A, lora_B in our layout, the scale among them, and biases
    and modules that were trained in full."""
    for name in (CONFIG, TENSORS):
        if not (folder / name).is_file():
            raise ValueError(f"{folder} holds no {name}; a PEFT adapter is a folder with both.")
    try:
        config = json.loads(read_whole(folder / CONFIG))
        kind = config["peft_type"]
        _check(config)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{folder / CONFIG} is damaged or no PEFT adapter: {error}") from error
    tensors = read_tensors(folder / TENSORS, read_whole(folder / TENSORS))
    if kind not in ("LORA", "ADALORA"):
        raise ValueError(f"{folder} holds {str(kind)[:40]}; LORA and ADALORA can be loaded.")
    if asked := [name for name in _UNKNOWN if config.get(name) not in _NOTHING]:
        raise ValueError(
            f"{folder} sets {asked[0]} to {reprlib.repr(config[asked[0]])}, which is not "
            "supported: merge it into its base in PEFT (merge_and_unload), and load the result."
        )
    if (start := config.get("init_lora_weights")) not in _WHOLE_BASE:
        raise ValueError(
            f"{folder} was trained on what {reprlib.repr(start)} left of its base: save it in PEFT "
            "with path_initial_model_for_weight_conversion, which makes a plain LoRA of it."
        )
    modules, whole = collections.defaultdict(dict), {}
    for name, tensor in tensors.items():
        if match := _TENSOR.fullmatch(name):
            modules[match[1]][match[2]] = tensor.astype(np.float32)
        elif (match := _WHOLE.fullmatch(name)) and _trains(config, match[1], match[3]):
            whole[match[1], match[3]] = tensor.astype(np.float32)
        else:
            raise ValueError(f"{folder} holds {short(name)}, which belongs to no LoRA.")
    try:
        alphas = values_of(config.get("alpha_pattern") or {}, modules, config.get("lora_alpha"))
        imported = {
            name: _imported(config, name, found, alphas[name]) for name, found in modules.items()
        }
        return config, imported, whole
    except (ValueError, TypeError, LookupError, ArithmeticError, RecursionError) as error:
        raise ValueError(f"{folder} is no PEFT adapter that can be read: {error}") from error


def _trains(config: Mapping[str, Any], module: str, kind: str) -> bool:
    """Whether a folder may hold a whole weight or bias."""
    saved = any(f".{name}." in f".{module}." for name in config.get("modules_to_save") or ())
    return saved or (kind == "bias" and config.get("bias") in ("all", "lora_only"))


def _imported(config: Mapping[str, Any], module: str, found: Adapter, alpha: Any) -> Adapter:
    """lora_a, lora_b, perhaps magnitude, and scale, in our layout."""
    ada = config["peft_type"] == "ADALORA"
    needed = {"lora_A", "lora_B"} | ({"lora_E"} if ada else set())
    needed |= {"lora_magnitude_vector"} if config.get("use_dora") else set()
    if missing := needed - found.keys():
        raise ValueError(f"the adapter of {module} lacks {min(missing)}.")
    if beyond := found.keys() - needed:
        raise ValueError(f"the adapter of {module} has {min(beyond)}, which its kind does not.")
    a, b = found["lora_A"].T, found["lora_B"].T
    if not alpha or (ada and not config.get("init_r")):
        raise ValueError(f"the adapter of {module} lacks lora_alpha or init_r, which scale it.")
    if ada:
        scale = alpha / (config["init_r"] + _ADA_CONSTANT)
        a = a * found["lora_E"][:, 0]
    else:
        rank = a.shape[1]
        scale = alpha / (math.sqrt(rank) if config.get("use_rslora") else rank)
    if not math.isfinite(scale):
        raise ValueError(f"the adapter of {module} has the scale {scale}.")
    adapter = {"lora_a": a, "lora_b": b, "scale": np.float32(scale)}
    if "lora_magnitude_vector" in found:
        adapter["magnitude"] = found["lora_magnitude_vector"].reshape(-1)
    return adapter


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and type(value) is not bool and abs(value) < math.inf


def _is_alpha(value: Any) -> bool:
    return _is_number(value) and 1 / MAX_ALPHA <= abs(value) <= MAX_ALPHA


def _is_size(value: Any) -> bool:
    return type(value) is int and 1 <= value <= MAX_SIZE


def _are_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


_KINDS: dict[str, tuple[Callable[[Any], bool], tuple[str, ...]]] = {
    "true or false": (
        lambda value: type(value) is bool,
        ("use_dora", "use_rslora", "use_qalora", "fan_in_fan_out", "inference_mode", "lora_bias"),
    ),
    f"a number other than 0, up to {MAX_ALPHA:g}": (_is_alpha, ("lora_alpha",)),
    "an object of such numbers": (
        lambda value: isinstance(value, dict) and all(map(_is_alpha, value.values())),
        ("alpha_pattern",),
    ),
    f"a whole number from 1 to {MAX_SIZE}": (_is_size, ("r", "init_r", "target_r")),
    "a number from 0 on, less than 1": (
        lambda value: _is_number(value) and 0 <= value < 1,
        ("lora_dropout",),
    ),
    "a text": (
        lambda value: isinstance(value, str),
        ("peft_type", "base_model_name_or_path", "revision", "task_type"),
    ),
    "'none', 'all' or 'lora_only'": (
        lambda value: value in ("none", "all", "lora_only"),
        ("bias",),
    ),
    "a text or a list of texts": (
        lambda value: isinstance(value, str) or _are_texts(value),
        ("target_modules", "exclude_modules", "layers_pattern"),
    ),
    "a list of texts": (_are_texts, ("modules_to_save", "target_parameters")),
    "true, false or a text": (
        lambda value: type(value) is bool or isinstance(value, str),
        ("init_lora_weights",),
    ),
    "an object": (lambda value: isinstance(value, dict), ("rank_pattern", "loftq_config")),
}


def _check(config: Mapping[str, Any]) -> None:
    """Raises a ValueError that names a field of another type, or beyond all sense."""
    for words, (fits, names) in _KINDS.items():
        for name in names:
            value = config.get(name)
            if value is not None and not fits(value):
                raise ValueError(f"{name} must be {words}, got {reprlib.repr(value)}")
