"""Adapters in the layers of an unmodified Linen model, by path rules.

    adapter = lorasp_jax.LinenAdapter(model, rules)
    variables = adapter.init(key, x)                       # or adapter.attach(key, published, x)
    y = adapter.apply(variables, x)

What trains is the collection "adapters"; "params" stays as the model's own `init`, or whoever
published it, made it. While the model runs, each adapter lies among its layer's own parameters:
whatever the model does to those (scan, remat, vmap), happens to the adapter too.
"""

import dataclasses
import functools
import operator
from collections.abc import Callable, Mapping
from typing import Any, cast

import flax.core
import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.traverse_util import flatten_dict, unflatten_dict

from lorasp_jax import _compat
from lorasp_jax.adapters.adaptation import init_stack, over_stack
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.adapters.layers.einsum import to_matrices
from lorasp_jax.adapters.layers.linen_layers import layer_call, supported_class, with_lora
from lorasp_jax.adapters.layers.nnx_layers import Einsums
from lorasp_jax.adapters.paths import Rules, check_method_rules, find_rule, no_match_message
from lorasp_jax.dense import AUX_NAME, validate
from lorasp_jax.peft import Method, _arguments
from lorasp_jax.peft._method import dropout_rate

ADAPTER = "lorasp_adapter"  # name of an adapter among its layer's parameters
# Set on scopes of the model: its code may apply other modules, which have variables of their own,
# as Hugging Face's tied heads do.
OURS = "lorasp_jax"
DROPS = "lorasp_jax_dropout"  # on scopes of a call that got rngs for "dropout"
Next = Callable[..., Any]


@dataclasses.dataclass(frozen=True)
class LinenAdapter:
    """A Linen model whose layers carry adapters; the model itself is left as it is.

    Adapters apply to `nn.Dense`, `nn.DenseGeneral` and `nn.Einsum` at their paths, LoRA to
    `nn.Embed` and `nn.Conv` too, as in `adapt` for NNX. `FullFineTuning` applies to every parameter
    under the paths it matches, which moves to "adapters" in fp32. In a scanned stack a path has no
    index, and adapters are stacked like the kernels; what such layers report reaches `collect_aux`
    only if the model's own scan lists "intermediates". Subclasses with a call of their own are left
    alone.

    Attributes:
      model: any Linen module; for a Flax model of Hugging Face, its `.module`.
      rules: (pattern, method or None) pairs, first match wins.
      einsums: further layer classes that do nothing but an einsum of their input and a parameter,
        each with a function of the layer that gives the parameter's name and the equation, as for
        `adapt`; {gemma.Einsum: lambda layer: ("w", None)} if the equation comes with the call.
    """

    model: nn.Module
    rules: Rules
    einsums: Einsums = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raises a ValueError for what is no Linen module or no rules."""
        check_method_rules(self.rules)
        nnx_layers.check_einsums(self.einsums)
        if not isinstance(self.model, nn.Module):
            raise ValueError(
                f"the model must be a Linen module, got {type(self.model).__name__}; `adapt` takes "
                "NNX modules."
            )

    def init(self, key: Any, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Variables of the model, as from its own `init`, and the collection "adapters".

        Args:
          key: typed random key, or a dictionary with one for "params" and others.
          *args: as for a call of the model.
          **kwargs: as for a call of the model.

        Raises:
          ValueError: as for `attach`.
        """
        return self.attach(key, self.model.init(_rngs(key), *args, **kwargs), *args, **kwargs)

    def attach(
        self, key: Any, variables: Mapping[str, Any], *args: Any, **kwargs: Any
    ) -> dict[str, Any]:
        """The variables of a model, for instance published ones, with the collection "adapters".

        Args:
          key: as for `init`.
          variables: with "params"; not modified.
          *args: as for a call of the model.
          **kwargs: as for a call of the model.

        Raises:
          ValueError: a rule that governs nothing that it applies to (lists near misses), a layer
            that an adapter cannot take over, or adapters that are there already.
        """
        if ADAPTER in {
            name for path in flatten_dict(validate.variables(variables)) for name in path
        }:
            raise ValueError("these variables have adapters already: start from the model's own.")
        rngs = _rngs(key)
        record = _Record()
        visit = functools.partial(self._attach, record)
        params = self._visited(visit, variables, *args, rngs=rngs, **kwargs)
        base, trained = self._divided(flatten_dict(params), record)
        for i, (pattern, _) in enumerate(self.rules):
            if i not in record.used:
                raise ValueError(no_match_message(pattern, record.seen, record.others))
        trained = flatten_dict(variables.get("adapters", {})) | trained
        return {**variables, "params": unflatten_dict(base), "adapters": unflatten_dict(trained)}

    def apply(
        self, variables: Mapping[str, Any], *args: Any, mutable: Any = False, **kwargs: Any
    ) -> Any:
        """What the model's own `apply` returns, computed with the adapters.

        Args:
          variables: from `init` or `attach`, the adapters perhaps trained.
          *args: as for the model.
          mutable: as for the model, but for "params"; with "intermediates" in it `collect_aux`
            finds what the layers reported.
          **kwargs: as for the model; the methods' dropout is on if rngs has a "dropout".

        Raises:
          ValueError: variables without an adapter that the rules ask for, mutable "params", or a
            scan that hands no rngs for dropout on.
        """
        if _compat.is_mutable(mutable, "params"):
            raise ValueError("'params' cannot be mutable: it holds the adapters during the call.")
        with nn.intercept_methods(self._call):
            return _apply(self.model, _joined(variables), *args, mutable=mutable, **kwargs)

    def merge(self, variables: Mapping[str, Any], *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Variables of the bare model that compute the same.

        An embedding whose table the model also reads past the layer, for tied logits, is adapted
        where it is looked up, but merged for both: give such a layer no adapter.

        Args:
          variables: as for `apply`.
          *args: as for a call of the model, which tells what its layers do.
          **kwargs: as for a call of the model.

        Raises:
          ValueError: a method whose delta depends on the input.
        """
        params = self._visited(self._merge, _joined(variables), *args, **kwargs)
        flat = {path: v for path, v in flatten_dict(params).items() if ADAPTER not in path}
        rest = {name: value for name, value in variables.items() if name != "adapters"}
        return {**rest, "params": unflatten_dict(flat)}

    def _visited(self, visit: Next, variables: Mapping[str, Any], *args: Any, **kwargs: Any) -> Any:
        """The parameters after a call of the model in which `visit` saw its layers."""

        def interceptor(run: Next, args: Any, kwargs: Any, context: nn.module.InterceptorContext):
            y = run(*args, **kwargs)
            if context.method_name == "__call__" and _is_ours(context.module):
                visit(context.module, args, kwargs)
            return y

        with nn.intercept_methods(interceptor):
            _, changed = _apply(self.model, variables, *args, mutable=True, **kwargs)
        return flax.core.unfreeze(changed["params"])

    def kernel_shapes(
        self, variables: Mapping[str, Any], *args: Any, **kwargs: Any
    ) -> dict[str, tuple[int, ...]]:
        """[..., *batch, I, O] by path of each layer that multiplies its input by a kernel.

        Args:
          variables: of the bare model.
          *args: as for a call of the model, which tells what its layers do.
          **kwargs: as for a call of the model.
        """
        found: dict[str, tuple[int, ...]] = {}

        def visit(module: nn.Module, args: Any, kwargs: Any) -> None:
            layer = (
                layer_call(module, self.einsums, args, kwargs)
                if self._supported_class(module)
                else None
            )
            if layer is None or layer.equation is None:
                return
            own = functools.reduce(operator.getitem, module.path, variables["params"])
            kernel = nn.meta.unbox(own[layer.name])  # with the axes of a scanned stack
            shaped = jax.ShapeDtypeStruct(kernel.shape, kernel.dtype)
            matrices = functools.partial(to_matrices, layer.equation)
            found["/".join(module.path)] = jax.eval_shape(matrices, shaped).shape

        self._visited(visit, validate.variables(variables), *args, **kwargs)
        return found

    def _supported_class(self, module: nn.Module) -> type[nn.Module] | None:
        """The known class that a layer of the model is called as."""
        return supported_class(module, self.einsums) if _is_ours(module) else None

    def _method(self, module: nn.Module) -> tuple[int, Method] | None:
        """The rule that gives the layer an adapter, and its method."""
        i = find_rule(self.rules, "/".join(module.path))
        method = None if i is None else self.rules[i][1]
        return None if i is None or method is None or method.trains_base else (i, method)

    def _attach(self, record: "_Record", module: nn.Module, args: Any, kwargs: Any) -> None:
        """Puts an adapter among the layer's parameters, if the rules say so."""
        path = "/".join(module.path)
        if not self._supported_class(module):
            own = module.variables.get("params", {})
            matrices = [n for n, value in own.items() if len(getattr(value, "shape", ())) > 1]
            record.others |= {path: type(module).__name__} if matrices else {}
            return
        record.seen.append(path)
        found = self._method(module)
        if found is None or module.has_variable("params", ADAPTER):
            return
        i, method = found
        try:
            layer = layer_call(module, self.einsums, args, kwargs)
            init, own_key = layer.adapter_init(method), module.make_rng("params")
            params, rest = init_stack(own_key, init, layer.matrices())
        except ValueError as error:
            raise ValueError(f"cannot adapt {path or 'the model'}: {error}") from error
        if method.splits_kernel:
            layer.set_matrices(rest)
        module.put_variable("params", ADAPTER, params)
        record.used.add(i)
        record.kernels.add((*module.path, layer.name))

    def _merge(self, module: nn.Module, args: Any, kwargs: Any) -> None:
        """Folds the layer's adapter into its kernel."""
        params, found = module.get_variable("params", ADAPTER), self._method(module)
        if params is None or found is None:
            return
        layer = layer_call(module, self.einsums, args, kwargs)
        matrices = layer.matrices()
        try:
            merged = over_stack(found[1].merge, matrices)(flax.core.unfreeze(params), matrices)
        except ValueError as error:
            raise ValueError(f"cannot merge {'/'.join(module.path)}: {error}") from error
        layer.set_matrices(merged)
        module.put_variable("params", ADAPTER, None)  # a layer may be called twice

    def _divided(self, params: dict[tuple, Any], record: "_Record") -> tuple[dict, dict]:
        """Flat parameters as those that are frozen and those that train."""
        base, trained = {}, {}
        for path, value in params.items():
            i = None
            if ADAPTER not in path:
                i = find_rule(self.rules, "/".join(path[:-1]), "/".join(path))
            method = None if i is None else self.rules[i][1]
            if i is not None and (method is None or method.trains_base):
                record.used.add(i)
            full = method is not None and method.trains_base
            if full and path in record.kernels:
                raise ValueError(
                    f"{'/'.join(path)} cannot train in full under the layer's adapter."
                )
            if full:
                # A copy: the train step may donate what trains.
                value = jax.tree.map(lambda v: jnp.array(v, jnp.float32, copy=True), value)
            (trained if full or ADAPTER in path else base)[path] = value
        return base, trained

    def _call(self, run: Next, args: Any, kwargs: Any, context: Any) -> Any:
        """The interceptor that computes adapted layers."""
        module = context.module
        if context.method_name not in ("__call__", "attend") or not self._supported_class(module):
            return run(*args, **kwargs)
        params, found = module.get_variable("params", ADAPTER), self._method(module)
        if (params is None) != (found is None):
            has = "no adapter" if params is None else "an adapter"
            raise ValueError(
                f"{'/'.join(module.path)} has {has}, against the rules: `init` or `attach` with "
                "these rules makes variables that fit."
            )
        if found is None:
            return run(*args, **kwargs)
        params, method = flax.core.unfreeze(params), cast(Any, found[1])
        if context.method_name == "attend":
            y = run(*args, **kwargs)
            return y + nnx_layers.attend_delta(method, params, *args, **kwargs).astype(y.dtype)
        layer = layer_call(module, self.einsums, args, kwargs)
        key = _dropout_key(module, method)
        if layer.equation:
            y, aux = layer.einsum(method, params, key)
        else:
            y, aux = with_lora(module, method, params, key, run(*args, **kwargs), *args, **kwargs)
        module.sow("intermediates", AUX_NAME, aux)
        return y


@dataclasses.dataclass
class _Record:
    """What a visit found: rules used, paths of layers, classes of other modules with matrices by
    path, kernels that have an adapter."""

    used: set[int] = dataclasses.field(default_factory=set)
    seen: list[str] = dataclasses.field(default_factory=list)
    others: dict[str, str] = dataclasses.field(default_factory=dict)
    kernels: set[tuple[str, ...]] = dataclasses.field(default_factory=set)


def _rngs(key: Any) -> dict[str, jax.Array]:
    """A key for each stream of random numbers; raises a ValueError for anything else."""
    rngs = dict(key) if isinstance(key, Mapping) else {"params": key}
    if "params" not in rngs:
        raise ValueError(f'rngs need a key for "params", got {sorted(map(str, rngs))}.')
    return {name: _arguments.key(value) for name, value in rngs.items()}


def _is_ours(module: nn.Module) -> bool:
    """Whether a module belongs to the model, and not to another that its code applies."""
    return module.scope is not None and module.scope.has_flag(OURS)


def _dropout_key(module: nn.Module, method: Method) -> jax.Array | None:
    """A key where the method has dropout and the call of the model got rngs for it, else None."""
    assert module.scope is not None
    if not dropout_rate(method) or not module.scope.has_flag(DROPS):
        return None
    if not module.has_rng("dropout"):
        raise ValueError(
            f"{'/'.join(module.path)} gets no rngs for its adapter's dropout: the scan or vmap "
            "around it needs 'dropout' in split_rngs."
        )
    return module.make_rng("dropout")


def _apply(model: nn.Module, variables: Any, *args: Any, method: Any = None, **kwargs: Any) -> Any:
    """`model.apply`, in scopes that can be told from others."""

    def run(module: nn.Module, *args: Any, **kwargs: Any) -> Any:
        assert module.scope is not None
        drops = {DROPS: True} if module.has_rng("dropout") else {}
        module.scope.flags = module.scope.flags.copy({OURS: True} | drops)
        if callable(method):
            return method(module, *args, **kwargs)
        return getattr(module, method or "__call__")(*args, **kwargs)

    return model.apply(variables, *args, method=run, **kwargs)


def _joined(variables: Mapping[str, Any]) -> dict[str, Any]:
    """The variables with everything that trains where the model looks for it."""
    trained = flatten_dict(flax.core.unfreeze(validate.variables(variables).get("adapters", {})))
    params = flatten_dict(flax.core.unfreeze(variables["params"])) | trained
    return {**variables, "params": unflatten_dict(params)}
