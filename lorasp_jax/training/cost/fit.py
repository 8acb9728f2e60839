"""Choose settings with which a run fits into the memory of a GPU: `--fit 16GB`.

Candidates are tried in the order of their `cost`, the expected time of a step relative to the
fastest; those that round the base cost more than the time they take. The first one whose estimated
peak fits is chosen. On the GPU, its step is then compiled, which the run needs anyway; if XLA plans
more memory than there is, the next candidate is tried. A dataset is held on the device if what is
left has room for it, otherwise streamed, which costs less time than other settings. Demonstrations
of the expert are always held.
"""

import dataclasses
import itertools
import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
from rich.console import Console

from lorasp_jax.config import Config
from lorasp_jax.kernels.platform import multiplies_float8
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.training import records, rules
from lorasp_jax.training.base import base_model
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.cost.dry_run import plan_step, planned_bytes
from lorasp_jax.training.cost.preflight import GIB, REMATS
from lorasp_jax.training.run_folder import CONFIG_FILE, read_json

UNITS: dict[str, float] = {"GB": 1e9, "GiB": GIB}
CONTEXT = 0.75 * GIB
"""Memory that CUDA, cuBLAS and cuDNN take outside of JAX's allocator; 0.62 GiB on an H200."""
FILLED = 0.93
"""Share of the allocator's memory that a run may be expected to fill. Estimates and plans are up to
5 % below the peak, and XLA needs its temporary memory in one piece."""
# Times are those of `benchmarks/small_cards.py` for LoRA on an H200.
REMAT_COST = {"none": 1.0, "products": 1.03, "narrow": 1.1, "full": 1.5}
"""Time of a step by rematerialization; pi0.5 in nf4, 4 windows: 86 ms with "products", 125 ms with
"full"."""
WINDOW_COST = 1.0
"""What a micro-batch costs beside its windows, in windows: 1.2 for pi0.5 in nf4, whose 4 windows
take 86, 107 and 147 ms in 1, 2 and 4 parts; in bf16, 0.4 for pi0.5 and 1.5 for pi0."""
BASE_COST = {"": 1.0, "float8": 1.2, "int8": 1.25, "nf4": 1.5}
"""Time of a step by how the base is stored, which is 0.91 in float8 (pi0) and 1.08 in nf4 (pi0.5),
plus what rounding it counts: 0.3 in 8 bits, 0.4 in 4."""
DEFAULTS: dict[str, Any] = {
    "optim.accumulate": 1,
    "model.remat": "auto",
    "model.param_dtype": "float32",
    "model.base_dtype": "",
}
"""The settings that are chosen; one with another value is given."""


def read_size(text: str) -> float:
    """Return bytes; "16GB" is 16e9 bytes, "16GiB" is 16 x 2^30.

    Raises:
        ValueError: the text is no number with a unit.
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?) *(GB|GiB)", text)
    if not found or not float(found[1]):
        raise ValueError(f"--fit must be a size such as 16GB or 14.5GiB, got {text!r}")
    return float(found[1]) * UNITS[found[2]]


def fitted(
    config: Config, size: str, given: Collection[str], folder: Path, console: Console
) -> Config:
    """Return the config with the cheapest settings that fit into a GPU of `size`.

    Args:
        config: a config whose batch size and given settings stay as they are.
        size: memory of the GPU, see `read_size`.
        given: names of settings, such as "optim.accumulate", that are kept although they have their
            default values. Others are kept, too.
        folder: the run's folder.
        console: prints what was chosen.

    Raises:
        ValueError: nothing fits, or see `setup.build`.
    """
    available, least, held = budget(size), float("inf"), 0
    for candidate, peak in ranked(config, given):
        if peak <= available:
            step = plan_step(_without_weights(candidate), folder, console, available)
            held, compile_step = step[1:]
            planned = planned_bytes(compile_step()) if jax.default_backend() != "cpu" else {}
            peak = max(peak, sum(planned.values())) + held
        if peak <= available:
            _describe(candidate, size, peak, held, console)
            return candidate
        least = min(least, peak)
    need = (least / FILLED + CONTEXT) / UNITS["GB"] + 0.05
    data = "" if held or config.data.source else ", and room for its demonstrations"
    raise ValueError(
        f"this run does not fit into {size}: its batch size and given settings need at least "
        f"--fit {need:.1f}GB{data}; see what else saves memory in docs/launch.md"
    )


def budget(size: str) -> float:
    """Return the bytes that a run on a GPU of `size` may be expected to need."""
    return FILLED * (read_size(size) - CONTEXT)


def ranked(config: Config, given: Collection[str] = ()) -> Iterator[tuple[Config, float]]:
    """Yield candidates and their estimated peaks [bytes], the cheapest first; see `fitted`."""
    base, _ = base_model(_without_weights(config), abstract=True)
    for candidate in _candidates(config, given):
        yield candidate, expected_peak(candidate, base.config)


def resumed(config: Config, given: Collection[str], folder: Path) -> Config | None:
    """Return the config with what was chosen when the run in `folder` started; None: there is none.

    Settings that are given stay as they are.

    Raises:
        ValueError: the run's config is corrupt.
    """
    if not (recorded := read_json(folder / CONFIG_FILE, records.CONFIG)):
        return None
    groups: dict[str, dict[str, Any]] = {}
    for name in DEFAULTS.keys() - given:
        (group, field), default = name.split("."), DEFAULTS[name]
        groups.setdefault(group, {})[field] = recorded[group].get(field, default)
    parts: dict[str, Any] = {
        group: dataclasses.replace(getattr(config, group), **values)
        for group, values in groups.items()
    }
    return dataclasses.replace(config, **parts)


def cost(config: Config) -> float:
    """Return the time of a step relative to the fastest, plus what rounding the base counts."""
    micro_batch = config.optim.batch_size / (jax.device_count() * config.optim.accumulate)
    small = 1 + WINDOW_COST / micro_batch
    return REMAT_COST[config.model.remat] * BASE_COST[config.model.base_dtype] * small


def expected_peak(config: Config, backbone: BackboneConfig) -> float:
    """Estimate the peak memory of a run on each device, training or evaluating.

    `backbone` has the sizes; the config overrides the rest.
    """
    model = config.model
    lengths = {"max_tokens": model.max_tokens, "chunk": model.chunk}
    changes: dict[str, Any] = {name: value for name, value in lengths.items() if value}
    changes |= {"remat": model.remat, "param_dtype": model.param_dtype}
    backbone = dataclasses.replace(backbone, **changes)
    training = preflight.estimate_memory(config, backbone).peak
    return max(training, preflight.sampling_peak(config, backbone))


def _candidates(config: Config, given: Collection[str]) -> list[Config]:
    """Return all choices of the settings that are not given, the cheapest first."""
    windows = max(1, config.optim.batch_size // jax.device_count())
    quantized = ("float8" if multiplies_float8() else "int8", "nf4")
    choices: dict[str, Sequence[Any]] = {
        "optim.accumulate": [n for n in range(1, windows + 1) if windows % n == 0],
        "model.remat": REMATS,
        "model.param_dtype": ("float32", "bfloat16"),
        "model.base_dtype": ("",) if rules.trains_base(config) else ("", *quantized),
    }
    fields = [name.split(".") for name in choices]
    for name, (group, field) in zip(choices, fields, strict=True):
        value = getattr(getattr(config, group), field)
        if name in given or value != DEFAULTS[name]:
            choices[name] = REMATS if value == "auto" else (value,)
    found = []
    for accumulate, remat, param_dtype, base_dtype in itertools.product(*choices.values()):
        if base_dtype and param_dtype == "float32" and len(choices["model.param_dtype"]) > 1:
            continue  # of no use beside rounded matrices
        optim = dataclasses.replace(config.optim, accumulate=accumulate)
        storage = {"param_dtype": param_dtype, "base_dtype": base_dtype}
        model = dataclasses.replace(config.model, remat=remat, **storage)
        found.append(dataclasses.replace(config, optim=optim, model=model))
    return sorted(found, key=lambda each: (cost(each), each.model.param_dtype == "bfloat16"))


def _without_weights(config: Config) -> Config:
    """Return the config with a random base, of which only shapes are used and no tasks replayed."""
    replay = config.data.replay if config.data.source else 0.0
    return dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, checkpoint=""),
        data=dataclasses.replace(config.data, replay=replay),
    )


def _describe(config: Config, size: str, peak: float, held: float, console: Console) -> None:
    allocator, model, optim = read_size(size) - CONTEXT, config.model, config.optim
    chosen = {
        "--optim.accumulate": optim.accumulate,
        "--model.remat": model.remat,
        "--model.param-dtype": model.param_dtype,
        "--model.base-dtype": model.base_dtype or "''",
    }
    options = " ".join(f"{name} {value}" for name, value in chosen.items())
    text = (
        f"--fit {size} chose {options}: {peak / GIB:.1f} of {allocator / GIB:.1f} GiB at the peak, "
    )
    text += (
        f"with {held / GIB:.1f} GiB of data that is held on the device"
        if held
        else "and a dataset that is streamed from disk, for which there is no room"
    )
    console.print(text, soft_wrap=True, markup=False)
