"""Replace LoRA-SP adapters by smaller ones and measure the error on a calibration set.

Shared by `pruning` and `distillation`. Batch axes of an einsum are treated like those of a stack.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from flax import nnx

from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.compress import calibration
from lorasp_jax.adapters.compress.calibration import Forward
from lorasp_jax.dense import AdaptedLayer, AdapterParam, validate
from lorasp_jax.peft import Method
from lorasp_jax.peft.lora_sp.bank import BankMethod
from lorasp_jax.peft.method import Params

Replacements = dict[str, tuple[Method, Params]]
"""New adapters by path."""


class Compaction(NamedTuple):
    """Ranks of the smaller adapters, and their error on the calibration set.

    Attributes:
        ranks: required rank by path, int `[...]`, one per layer of a stack.
        output_error: relative error ‖Δy‖ / ‖y‖ over all outputs y of the model.
    """

    ranks: dict[str, np.ndarray]
    output_error: float


def lora_sp_layers(model: nnx.Module) -> dict[str, Any]:
    """Layers with a LoRA-SP adapter, by path.

    Raises:
        ValueError: the model has no such layers, or has shapes without values.
    """
    locations = paths.locate(nnx.List([validate.with_values(model)]), AdaptedLayer)
    layers = {p.path: p.child for p in locations if isinstance(p.child.method, BankMethod)}
    if not layers:
        raise ValueError("the model has no LoRA-SP layers")
    return layers


def replace_adapters(
    model: adaptation.Model,
    batches: Sequence[Any],
    replacements: Replacements,
    ranks: dict[str, np.ndarray],
    forward: Forward,
) -> tuple[adaptation.Model, Compaction]:
    """Replace adapters in a copy of the model, and measure the error on the batches."""
    root = nnx.List([nnx.clone(model)])
    for location in paths.locate(root, AdaptedLayer):
        if location.path in replacements:
            location.child.method, params = replacements[location.path]
            location.child.adapter = AdapterParam(params)
    smaller = root[0]
    before, after = (calibration.outputs(m, forward) for m in (model, smaller))
    error = norm = 0.0
    for batch in batches:
        for a, b in zip(before(batch), after(batch), strict=True):
            a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
            error, norm = error + np.square(b - a).sum(), norm + np.square(a).sum()
    if not np.isfinite(error + norm):
        raise ValueError("the model's outputs are not finite")
    output_error = float(np.sqrt(error / max(norm, np.finfo(np.float32).tiny)))
    return smaller, Compaction(ranks, output_error)
