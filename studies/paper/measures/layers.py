"""The dense layers of a policy's model by tower, with one kernel for each layer of a stack."""

from typing import Any

import numpy as np
from flax import nnx

from lorasp_jax.adapters import paths
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.training.rules import short_name, tower


def by_tower(values: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Arrange values by layer path as tower -> short name -> value."""
    towers: dict[str, dict[str, Any]] = {}
    for path, value in values.items():
        towers.setdefault(tower(path), {})[short_name(path)] = value
    return towers


def kernels(model: nnx.Module) -> dict[str, np.ndarray]:
    """Return the kernels of all dense layers by path, f64 `[L, I, O]`; L is 1 if not stacked."""
    found = {}
    for location in paths.locate_matmul_layers(nnx.List([model])):
        layer = nnx_layers.make_adaptable(location.child, {})
        matrices = np.asarray(layer.kernel_matrices(), np.float64)
        found[location.path] = matrices.reshape(-1, *matrices.shape[-2:])
    return found
