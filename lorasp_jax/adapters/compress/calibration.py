"""Collect activation statistics of a model's layers over the valid tokens of a calibration set.

Covers dense layers and einsums; embeddings and convolutions are skipped.

Each layer's method is wrapped in `Observed`, which leaves the output unchanged and reports sums in
`Aux` under the layer's path. The sums are read from the model's output and from the layers that
store aux.
"""

import dataclasses
import functools
import re
from collections.abc import Callable, Iterable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters import paths
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.dense import AdapterAux, AdapterParam, validate
from lorasp_jax.kernels.frozen_matmul import frozen_matmul
from lorasp_jax.peft.method import Aux, Mask, Method, Params

Forward = Callable[[Any, Any], Any]
"""(model, batch) -> output pytree, which must include any aux that the model returns. All other
arrays in it count as output."""
Sums = dict[str, jax.Array]
Report = Callable[["Layer"], Sums]


def call(model: Any, batch: Any) -> Any:
    """Default forward pass: `model(batch)`."""
    return model(batch)


@dataclasses.dataclass(frozen=True)
class Layer:
    """The argument of a report function: one layer call with one kernel matrix.

    Attributes:
        method: the layer's method, or None.
        params: the adapter's parameters, or {}.
        x: `[...tokens, I]`.
        aux: the method's aux.
        valid: bool `[...tokens]`.
    """

    method: Method | None
    params: Params
    x: jax.Array
    aux: Aux
    valid: jax.Array

    def rows(self, array: jax.Array) -> jax.Array:
        """Reshape `[...tokens, n]` to f32 `[T, n]`, with invalid tokens zeroed."""
        array = jnp.where(self.valid[..., None], array, 0).astype(jnp.float32)
        return array.reshape(-1, array.shape[-1])


@dataclasses.dataclass(frozen=True)
class Observed(Method):
    """Wrap a layer's method to report sums; the parameters are those of `inner`."""

    is_low_rank_sum: ClassVar[bool] = False

    path: str
    inner: Method | None
    report: Report

    def apply(
        self, params: Params, x: jax.Array, kernel: jax.Array, *, token_mask: Mask = None
    ) -> tuple[jax.Array, Aux]:
        """Return the wrapped layer's output, with the report in aux."""
        if self.inner is None:
            y, aux = frozen_matmul(x, kernel), Aux()
        else:
            y, aux = self.inner.apply(params, x, kernel, token_mask=token_mask)
        valid = jnp.ones(x.shape[:-1], bool) if token_mask is None else token_mask
        sums = self.report(Layer(self.inner, params, x, aux, valid))
        sums["tokens"] = valid.sum().astype(jnp.float32)
        return y, dataclasses.replace(aux, statistics={self.path: sums})


def observe(
    model: nnx.Module,
    batches: Iterable[Any],
    reports: dict[str, Report],
    forward: Forward = call,
) -> dict[str, Sums]:
    """Sum the reports of the given layers over batches.

    Args:
        model: not modified.
        batches: inputs of `forward`; use one shape to avoid recompilation.
        reports: report functions by layer path; see `paths.locate_matmul_layers`.
        forward: how to call the model.

    Returns:
        Sums by path, including "tokens", the number of valid tokens. All sums have the leading axes
        of the layer's kernel matrices: those of a scanned stack and the batch axes of an einsum.

    Raises:
        ValueError: there are no batches or no valid tokens, values are not finite, a layer was not
            called, its aux was not returned by `forward`, or it has a custom matmul or precision.
    """
    step = _make_step(_make_observed(model, reports), forward)
    total: dict[str, Sums] = {}
    for batch in batches:
        _add(total, step(batch))
    if missing := sorted(reports.keys() - total.keys()):
        raise ValueError(f"no statistics for {missing[0]}: `forward` must call it and return aux")
    for path, sums in total.items():
        if not np.any(sums["tokens"]):
            raise ValueError(f"the batches have no valid tokens for {path or 'the model'}")
        if not all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(sums)):
            raise ValueError(f"activations of {path or 'the model'} are not finite")
    return total


def outputs(model: nnx.Module, forward: Forward = call) -> Callable[[Any], list[jax.Array]]:
    """Jitted function from a batch to the model's floating-point outputs, without aux."""
    graphdef, state = nnx.split(model)
    run = jax.jit(lambda state, batch: _arrays(forward(nnx.merge(graphdef, state), batch)))
    return functools.partial(run, state)


def _make_step(model: nnx.Module, forward: Forward) -> Callable[[Any], dict[str, Sums]]:
    """Jitted function from a batch to the reports of an observed model."""
    graphdef, state = nnx.split(model)

    @jax.jit
    def step(state: Any, batch: Any) -> dict[str, Sums]:
        model = nnx.merge(graphdef, state)
        returned = [aux for aux in _nodes(forward(model, batch)) if isinstance(aux, Aux)]
        stored = nnx.to_flat_state(nnx.pop(model, AdapterAux))
        total: dict[str, Sums] = {}
        for aux in [*returned, *(variable.get_value() for _, variable in stored)]:
            _add(total, aux.statistics)
        return total

    return functools.partial(step, state)


def _make_observed(model: nnx.Module, reports: dict[str, Report]) -> nnx.Module:
    """Copy the model, with the methods of some layers wrapped in `Observed`."""
    root = nnx.List([nnx.clone(model)])
    nnx.pop(root, AdapterAux)
    for location in paths.locate_matmul_layers(root):
        path = location.path
        if path not in reports:
            continue
        with paths.naming("observe", path):
            layer = nnx_layers.make_adaptable(location.child, {})
        paths.set_child(location, layer)
        if layer.adapter is None:
            layer.method, layer.adapter = None, AdapterParam({})
        layer.method = Observed(path, layer.method, reports[path])
    return root[0]


def _nodes(tree: Any) -> list[Any]:
    return jax.tree.leaves(tree, is_leaf=lambda node: isinstance(node, Aux))


def _arrays(tree: Any) -> list[jax.Array]:
    leaves = [leaf for leaf in _nodes(tree) if not isinstance(leaf, Aux)]
    return [leaf for leaf in leaves if jnp.issubdtype(jnp.result_type(leaf), jnp.floating)]


def _add(total: dict[str, Sums], more: Any) -> None:
    for path, sums in more.items():
        total[path] = jax.tree.map(jnp.add, total[path], sums) if path in total else dict(sums)


def input_moments(
    model: nnx.Module, batches: Iterable[Any], pattern: str = ".*", forward: Forward = call
) -> dict[str, jax.Array]:
    """Uncentered second moments Σ x xᵀ of layer inputs, f32 `[..., I, I]` by path.

    LoRA's initialization "eva" requires them in `adapt(..., statistics=...)`. Covers dense layers
    and einsums whose path matches the pattern; third-party einsum layers must already be adapted.

    Raises:
        ValueError: as for `observe`, or the pattern matches no dense layer or einsum.
    """
    paths.check_rules([(pattern, None)], lambda _: True, "None")
    layer_paths = [
        location.path
        for location in paths.locate_matmul_layers(nnx.List([validate.with_values(model)]))
    ]
    reports = {path: second_moment for path in layer_paths if re.search(pattern, path)}
    if not reports:
        raise ValueError(paths.no_match_message(pattern, layer_paths, {}))
    sums_by_path = observe(model, batches, reports, forward)
    return {path: sums["moment"] for path, sums in sums_by_path.items()}


def second_moment(layer: Layer) -> Sums:
    """Second moment Σ x xᵀ over the valid tokens."""
    x = layer.rows(layer.x)
    return {"moment": x.T @ x}
