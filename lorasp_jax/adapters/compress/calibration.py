"""What passes through a model's layers on a calibration set, summed over its valid tokens.

That is dense layers and einsums, which multiply their input, as rows [...tokens, I], by a matrix.
Embeddings and convolutions do not and are left out.

Each layer's method is wrapped in one that leaves the output alone and reports sums in `Aux`, under
the layer's path. So they come out of any model that adapters work in: a stranger's, whose layers
keep them, and one that scans over its depth and returns them, stacked.
"""

import dataclasses
import functools
import re
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.dense import AdapterAux, AdapterParam, validate
from lorasp_jax.peft._fields import short
from lorasp_jax.peft._method import Aux, Method, Params

Forward = Callable[[Any, Any], Any]
"""(model, batch) -> its output, any tree. A model whose layers return their aux must return it with
its output; every other array counts as output."""
Sums = dict[str, jax.Array]
Report = Callable[["Layer"], Sums]


def call(model: Any, batch: Any) -> Any:
    """The forward pass of a model of one argument."""
    return model(batch)


@dataclasses.dataclass(frozen=True)
class Layer:
    """One call of one matrix of a layer, as a report of `layers.einsum` sees it.

    Attributes:
      method: the layer's own, or None.
      params: the adapter's, or {}.
      x: [...tokens, I].
      kernel: [I, O].
      y: [...tokens, O], without the bias.
      other: [...tokens, O], what another adapter would give, or None.
      aux: of the method.
      valid: bool [...tokens].
    """

    method: Method | None
    params: Params
    x: jax.Array
    kernel: jax.Array
    y: jax.Array
    other: jax.Array | None
    aux: Aux
    valid: jax.Array

    def rows(self, array: jax.Array) -> jax.Array:
        """[...tokens, n] as f32 [T, n], zero where a token does not count."""
        array = jnp.where(self.valid[..., None], array, 0).astype(jnp.float32)
        return array.reshape(-1, array.shape[-1])


@dataclasses.dataclass(frozen=True)
class Observed(Method):
    """A layer's own method, with a report. Parameters: its own, or a pair with another method's."""

    path: str
    inner: Method | None
    report: Report
    another: Method | None = None

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """None of its own."""
        del key, d_in, d_out
        return {}

    def apply(
        self,
        params: Params,
        x: jax.Array,
        kernel: jax.Array,
        *,
        token_mask: jax.Array | None = None,
    ) -> tuple[jax.Array, Aux]:
        """What the layer gives without it, and the report."""
        other = None
        if self.another is not None:
            params, others = params
            other, _ = self.another.apply(others, x, kernel, token_mask=token_mask)
        if self.inner is None:
            y, aux = x @ kernel.astype(x.dtype), Aux()
        else:
            y, aux = self.inner.apply(params, x, kernel, token_mask=token_mask)
        valid = jnp.ones(x.shape[:-1], bool) if token_mask is None else token_mask
        sums = self.report(Layer(self.inner, params, x, kernel, y, other, aux, valid))
        sums["tokens"] = valid.sum().astype(jnp.float32)
        return y, dataclasses.replace(aux, statistics={self.path: sums})


def observe(
    model: nnx.Module,
    batches: Iterable[Any],
    reports: dict[str, Report],
    forward: Forward = call,
    others: Mapping[str, tuple[Method, Params]] = MappingProxyType({}),
) -> dict[str, Sums]:
    """The reports of some layers, summed over batches.

    Args:
      model: not modified.
      batches: of one shape each, or it compiles for each.
      reports: by path of a layer, of those of `paths.multiplying`.
      forward: how to call the model.
      others: adapters by path that some layers' output is to be compared with.

    Returns:
      Sums by path, with "tokens", the number of valid ones, all with the leading axes of the
      layer's kernel matrices: those of a scanned stack and the batch axes of an einsum.

    Raises:
      ValueError: no batches, no token in them, or numbers that are not finite; a layer that was not
        called or whose aux `forward` did not return, or one with its own matrix product, precision
        or the like.
    """
    if not isinstance(batches, Iterable) or isinstance(batches, str | Mapping):
        raise ValueError(f"batches are a list or the like of inputs, got {short(batches)}.")
    if not callable(forward):
        raise ValueError(f"forward is a function of model and batch, got {short(forward)}.")
    step = _stepping(_observed(model, reports, others), forward)
    total: dict[str, Sums] = {}
    for batch in batches:
        for leaf in jax.tree.leaves(batch):
            if not isinstance(leaf, jax.Array | np.ndarray | np.generic | float | int):
                raise ValueError(f"a batch holds arrays and numbers, got {short(leaf)}.")
        _add(total, step(batch))
    if missing := sorted(reports.keys() - total.keys()):
        raise ValueError(
            f"nothing was seen of {paths.near_misses(missing[0], missing)}: the batches must "
            "reach every layer, and `forward` must return the aux of a model that returns it."
        )
    for path, sums in total.items():
        if not np.any(sums["tokens"]):
            raise ValueError(f"the batches hold no token that counts for {path or 'the model'}.")
        if not all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(sums)):
            raise ValueError(f"numbers that are not finite reach {path or 'the model'}.")
    return total


def outputs(model: nnx.Module, forward: Forward = call) -> Callable[[Any], list[jax.Array]]:
    """The jitted function from a batch to the floating-point arrays beside aux."""
    graphdef, state = nnx.split(model)
    run = jax.jit(lambda state, batch: _arrays(forward(nnx.merge(graphdef, state), batch)))
    return functools.partial(run, state)


def _stepping(model: nnx.Module, forward: Forward) -> Callable[[Any], dict[str, Sums]]:
    """The jitted function from a batch to the reports of a model that reports."""
    graphdef, state = nnx.split(model)

    @jax.jit
    def step(state: Any, batch: Any) -> dict[str, Sums]:
        model = nnx.merge(graphdef, state)
        found = [aux for aux in _nodes(forward(model, batch)) if isinstance(aux, Aux)]
        kept = nnx.to_flat_state(nnx.pop(model, AdapterAux))
        total: dict[str, Sums] = {}
        for aux in [*found, *(variable.get_value() for _, variable in kept)]:
            _add(total, aux.statistics)
        return total

    return functools.partial(step, state)


def _observed(
    model: nnx.Module, reports: dict[str, Report], others: Mapping[str, tuple[Method, Params]]
) -> nnx.Module:
    """A copy of the model that reports."""
    root = nnx.List([nnx.clone(model)])
    nnx.pop(root, AdapterAux)
    for location in paths.locate_matmul_layers(root):
        path = location.path
        if path not in reports:
            continue
        try:
            layer = nnx_layers.make_adaptable(location.child, {})
        except ValueError as error:
            raise ValueError(f"cannot observe {path}: {error}") from error
        paths.set_child(location, layer)
        if layer.adapter is None:
            adaptation.attach(layer, Observed(path, None, reports[path]), jax.random.key(0))
        else:
            own, params = layer.method_and_params()
            method = Observed(path, own, reports[path])
            if path in others:
                another, its_params = others[path]
                method = dataclasses.replace(method, another=another)
                params = (params, its_params)
            layer.method = method
            layer.adapter = AdapterParam(params)
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
    """Σ x xᵀ of the inputs of the layers whose path matches, f32 [..., I, I] by path.

    It is what `adapt(..., statistics=...)` needs for LoRA's initialization "eva". Not centred. Of
    dense layers and einsums; other people's einsum classes are known once they are adapted.

    Raises:
      ValueError: as for `observe`, or no such layer matches.
    """
    paths.check_rules([(pattern, None)], lambda _: True, "None")
    known = [
        location.path
        for location in paths.locate_matmul_layers(nnx.List([validate.with_values(model)]))
    ]
    reports = {path: second_moment for path in known if re.search(pattern, path)}
    if not reports:
        close = paths.near_misses(pattern, known) or "none"
        raise ValueError(f"{short(pattern)} matches no dense layer or einsum; those here: {close}.")
    found = observe(model, batches, reports, forward)
    return {path: sums["moment"] for path, sums in found.items()}


def second_moment(layer: Layer) -> Sums:
    """Σ x xᵀ over the valid tokens."""
    x = layer.rows(layer.x)
    return {"moment": x.T @ x}
