"""Replace LoRA-SP adapters by smaller ones and measure the error on a calibration set.

Shared by `pruning` and `distillation`. A layer's error is measured on the inputs that the layer
receives in the original model. Batch axes of an einsum are treated like the axes of a stack.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.compress import calibration
from lorasp_jax.adapters.compress.calibration import Forward, Layer, Sums
from lorasp_jax.dense import AdaptedLayer, AdapterParam, validate
from lorasp_jax.peft import Method
from lorasp_jax.peft.lora_sp.bank import BankMethod
from lorasp_jax.peft.method import Params

Replacements = dict[str, tuple[Method, Params]]
"""New adapters by path."""


class Compaction(NamedTuple):
    """Ranks of the smaller adapters, and their errors on the calibration set.

    Attributes:
        ranks: required rank by path, int `[...]`, one per layer of a stack.
        layer_errors: relative error ‖Δy‖ / ‖y‖ of each layer's output y by path, f32 `[...]`. The
            bias is not part of y, and the norms are over valid tokens.
        output_error: relative error ‖Δy‖ / ‖y‖ over all outputs y of the model.
    """

    ranks: dict[str, np.ndarray]
    layer_errors: dict[str, np.ndarray]
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
    """Replace adapters in a copy of the model, and measure the errors on the batches.

    `ranks` are stored in the returned `Compaction`.
    """
    root = nnx.List([nnx.clone(model)])
    for location in paths.locate(root, AdaptedLayer):
        if location.path in replacements:
            location.child.method, params = replacements[location.path]
            location.child.adapter = AdapterParam(params)
    smaller = root[0]
    return smaller, Compaction(ranks, *_errors(model, smaller, batches, replacements, forward))


def _errors(
    model: nnx.Module,
    smaller: nnx.Module,
    batches: Sequence[Any],
    replacements: Replacements,
    forward: Forward,
) -> tuple[dict[str, np.ndarray], float]:
    """Relative error of each layer, by path, and relative error of the model output."""
    reports = dict.fromkeys(replacements, _squared_error)
    sums = calibration.observe(model, batches, reports, forward, replacements)
    layers = {
        path: np.sqrt(np.asarray(s["error"]) / np.maximum(s["norm"], np.finfo(np.float32).tiny))
        for path, s in sums.items()
    }
    before, after = (calibration.outputs(m, forward) for m in (model, smaller))
    error = norm = 0.0
    for batch in batches:
        for a, b in zip(before(batch), after(batch), strict=True):
            a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
            error, norm = error + np.square(b - a).sum(), norm + np.square(a).sum()
    return layers, float(np.sqrt(error / max(norm, np.finfo(np.float32).tiny)))


def _squared_error(layer: Layer) -> Sums:
    assert layer.reference_y is not None  # `observe` gets the replacements as references
    y, reference = layer.rows(layer.y), layer.rows(layer.reference_y)
    return {"error": jnp.square(reference - y).sum(), "norm": jnp.square(y).sum()}
