"""Attach adapters to the layers of an unmodified Linen model, by path rules.

    adapter = lorasp_jax.LinenAdapter(model, rules)
    variables = adapter.init(key, x)                       # or adapter.attach(key, pretrained, x)
    y = adapter.apply(variables, x)

The collection "adapters" is trainable; "params" holds the model's frozen parameters. During a call,
each adapter is stored among its layer's parameters, so the model's own transformations (scan,
remat, vmap) also apply to it.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, cast

import flax.core
import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.traverse_util import flatten_dict, unflatten_dict

from lorasp_jax.adapters import _compat, paths
from lorasp_jax.adapters.adaptation import init_stack, over_stack
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.adapters.layers.linen_layers import layer_call, supported_class, with_lora
from lorasp_jax.adapters.layers.nnx_layers import Einsums
from lorasp_jax.dense import AUX_NAME, validate
from lorasp_jax.peft import Method
from lorasp_jax.peft.fields import checked_key
from lorasp_jax.peft.method import dropout_rate

ADAPTER = "lorasp_adapter"  # parameter name of an adapter in its layer
# Marks the model's own scopes. Its code may apply other modules with separate variables, as Hugging
# Face's tied heads do.
MODEL_FLAG = "lorasp_jax"
DROPOUT_FLAG = "lorasp_jax_dropout"  # marks scopes of a call with rngs for "dropout"
Function = Callable[..., Any]


@dataclasses.dataclass(frozen=True)
class LinenAdapter:
    """A Linen model with adapters in its layers; the model itself is not modified.

    Adapters apply to `nn.Dense`, `nn.DenseGeneral` and `nn.Einsum`; LoRA also applies to `nn.Embed`
    and `nn.Conv`. Subclasses that override `__call__` are skipped. `FullFineTuning` moves every
    parameter under a matching path to "adapters", in fp32.

    Paths in a scanned stack have no index, and adapters are stacked like the kernels. For
    `collect_aux`, the `variable_axes` of the model's own scan must include "intermediates".

    Attributes:
        model: any Linen module; for a Hugging Face Flax model, its `.module`.
        rules: (pattern, method or None) pairs, first match wins.
        einsums: extra layer classes, as for `adapt`. The equation is None if it is an argument of
            the layer's call, as in {gemma.Einsum: lambda layer: ("w", None)}.
    """

    model: nn.Module
    rules: paths.Rules
    einsums: Einsums = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        paths.check_method_rules(self.rules)
        nnx_layers.check_einsums(self.einsums)

    def init(self, key: Any, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Initialize the variables with the model's own `init`, and add the collection "adapters".

        Args:
            key: typed PRNG key, or a dictionary of keys with one for "params".
            *args: the model's call arguments.
            **kwargs: the model's call arguments.

        Raises:
            ValueError: as for `attach`.
        """
        return self.attach(key, self.model.init(_rngs(key), *args, **kwargs), *args, **kwargs)

    def attach(
        self, key: Any, variables: Mapping[str, Any], *args: Any, **kwargs: Any
    ) -> dict[str, Any]:
        """Add the collection "adapters" to existing variables, for instance pretrained ones.

        Args:
            key: as for `init`.
            variables: variables of the bare model, with "params"; not modified.
            *args: the model's call arguments.
            **kwargs: the model's call arguments.

        Raises:
            ValueError: a rule applies to nothing (the message lists near misses), a layer is
                unsupported, or the variables already have adapters.
        """
        if any(ADAPTER in path for path in flatten_dict(validate.variables(variables))):
            raise ValueError("the variables already have adapters: pass those of the bare model")
        rngs = _rngs(key)
        record = _Record()
        visit = functools.partial(self._attach, record)
        params = self._visit_layers(visit, variables, *args, rngs=rngs, **kwargs)
        base, trained = self._partition(flatten_dict(params), record)
        for i, (pattern, _) in enumerate(self.rules):
            if i not in record.used:
                raise ValueError(paths.no_match_message(pattern, record.layers, record.others))
        trained = flatten_dict(variables.get("adapters", {})) | trained
        return {**variables, "params": unflatten_dict(base), "adapters": unflatten_dict(trained)}

    def apply(
        self, variables: Mapping[str, Any], *args: Any, mutable: Any = False, **kwargs: Any
    ) -> Any:
        """Like the model's own `apply`, with the adapters.

        Args:
            variables: from `init` or `attach`, possibly trained.
            *args: as for the model's `apply`.
            mutable: as for the model's `apply`, but must not include "params"; include
                "intermediates" for `collect_aux`.
            **kwargs: as for the model's `apply`; the adapters' dropout is on if rngs has "dropout".

        Raises:
            ValueError: the adapters in the variables do not match the rules, "params" is mutable,
                or a scan or vmap does not split the rngs for dropout.
        """
        if _compat.is_mutable(mutable, "params"):
            raise ValueError("'params' cannot be mutable: it contains the adapters during the call")
        with nn.intercept_methods(self._call):
            return _apply(
                self.model, _with_adapters_in_params(variables), *args, mutable=mutable, **kwargs
            )

    def merge(self, variables: Mapping[str, Any], *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Fold the adapters into the parameters; returns variables of the bare model.

        An embedding's adapter affects only lookups and `attend`, but merging changes the table
        itself. So do not adapt an embedding whose table the model also reads directly, as for tied
        logits.

        Args:
            variables: as for `apply`.
            *args: the model's call arguments; the model is called once to find its layers.
            **kwargs: the model's call arguments.

        Raises:
            ValueError: a method's delta depends on the input.
        """
        params = self._visit_layers(
            self._merge, _with_adapters_in_params(variables), *args, **kwargs
        )
        flat = {path: v for path, v in flatten_dict(params).items() if ADAPTER not in path}
        rest = {name: value for name, value in variables.items() if name != "adapters"}
        return {**rest, "params": unflatten_dict(flat)}

    def _visit_layers(
        self, visit: Function, variables: Mapping[str, Any], *args: Any, **kwargs: Any
    ) -> Any:
        """Call the model and `visit` each of its modules; return the new parameters."""

        def interceptor(
            next_fun: Function, args: Any, kwargs: Any, context: nn.module.InterceptorContext
        ):
            y = next_fun(*args, **kwargs)
            if context.method_name == "__call__" and _is_model_module(context.module):
                visit(context.module, args, kwargs)
            return y

        with nn.intercept_methods(interceptor):
            _, changed = _apply(self.model, variables, *args, mutable=True, **kwargs)
        return flax.core.unfreeze(changed["params"])

    def _supported_class(self, module: nn.Module) -> type[nn.Module] | None:
        """`supported_class`, or None if the module does not belong to the model."""
        return supported_class(module, self.einsums) if _is_model_module(module) else None

    def _rule(self, module: nn.Module) -> tuple[int, Method] | None:
        """Index and method of the rule that adapts the layer, or None."""
        i = paths.find_rule(self.rules, "/".join(module.path))
        method = None if i is None else self.rules[i][1]
        return None if i is None or method is None or method.trains_base else (i, method)

    def _attach(self, record: "_Record", module: nn.Module, args: Any, kwargs: Any) -> None:
        """Add an adapter to the layer's parameters, if a rule requires one."""
        path = "/".join(module.path)
        if not self._supported_class(module):
            params = module.variables.get("params", {})
            matrices = [n for n, value in params.items() if len(getattr(value, "shape", ())) > 1]
            record.others |= {path: type(module).__name__} if matrices else {}
            return
        record.layers.append(path)
        rule = self._rule(module)
        if rule is None or module.has_variable("params", ADAPTER):
            return
        i, method = rule
        with paths.naming("adapt", path):
            layer = layer_call(module, self.einsums, args, kwargs)
            init, key = layer.adapter_init(method), module.make_rng("params")
            params, rest = init_stack(key, init, layer.matrices())
            params = method.trimmed(params)
        if method.splits_kernel:
            layer.set_matrices(rest)
        module.put_variable("params", ADAPTER, params)
        record.used.add(i)
        record.kernels.add((*module.path, layer.name))

    def _merge(self, module: nn.Module, args: Any, kwargs: Any) -> None:
        """Fold the layer's adapter into its kernel."""
        params, rule = module.get_variable("params", ADAPTER), self._rule(module)
        if params is None or rule is None:
            return
        layer = layer_call(module, self.einsums, args, kwargs)
        matrices = layer.matrices()
        with paths.naming("merge", "/".join(module.path)):
            merged = over_stack(rule[1].merge, matrices)(flax.core.unfreeze(params), matrices)
        layer.set_matrices(merged)
        module.put_variable("params", ADAPTER, None)  # a layer called twice is merged once

    def _partition(self, params: dict[tuple, Any], record: "_Record") -> tuple[dict, dict]:
        """Split flat parameters into frozen and trainable ones."""
        base, trained = {}, {}
        for path, value in params.items():
            i = None
            if ADAPTER not in path:
                i = paths.find_rule(self.rules, "/".join(path[:-1]), "/".join(path))
            method = None if i is None else self.rules[i][1]
            if i is not None and (method is None or method.trains_base):
                record.used.add(i)
            full = method is not None and method.trains_base
            if full and path in record.kernels:
                raise ValueError(f"{'/'.join(path)} has an adapter and cannot be fully fine-tuned")
            if full:
                # A copy, since the train step may donate trainable arrays.
                value = jax.tree.map(lambda v: jnp.array(v, jnp.float32, copy=True), value)
            (trained if full or ADAPTER in path else base)[path] = value
        return base, trained

    def _call(self, next_fun: Function, args: Any, kwargs: Any, context: Any) -> Any:
        """Method interceptor that computes adapted layers."""
        module = context.module
        if context.method_name not in ("__call__", "attend") or not self._supported_class(module):
            return next_fun(*args, **kwargs)
        params, rule = module.get_variable("params", ADAPTER), self._rule(module)
        if (params is None) != (rule is None):
            path, has = "/".join(module.path), "no" if params is None else "an"
            raise ValueError(f"{path} has {has} adapter: `attach` it with the same rules")
        if rule is None:
            return next_fun(*args, **kwargs)
        params, method = flax.core.unfreeze(params), cast(Any, rule[1])
        if context.method_name == "attend":
            y = next_fun(*args, **kwargs)
            return y + nnx_layers.attend_delta(method, params, *args, **kwargs).astype(y.dtype)
        layer = layer_call(module, self.einsums, args, kwargs)
        key = _dropout_key(module, method)
        if layer.equation:
            y, aux = layer.einsum(method, params, key)
        else:
            y, aux = with_lora(
                module, method, params, key, next_fun(*args, **kwargs), *args, **kwargs
            )
        module.sow("intermediates", AUX_NAME, aux)
        return y


@dataclasses.dataclass
class _Record:
    """Results of `LinenAdapter._attach` over a model's modules.

    Attributes:
        used: indices of the rules used.
        layers: paths of supported layers.
        others: class names of other modules with matrices, by path.
        kernels: paths of kernels that have an adapter.
    """

    used: set[int] = dataclasses.field(default_factory=set)
    layers: list[str] = dataclasses.field(default_factory=list)
    others: dict[str, str] = dataclasses.field(default_factory=dict)
    kernels: set[tuple[str, ...]] = dataclasses.field(default_factory=set)


def _rngs(key: Any) -> dict[str, jax.Array]:
    """PRNG keys by stream name."""
    rngs = key if isinstance(key, Mapping) else {"params": key}
    return {name: checked_key(value) for name, value in rngs.items()}


def _is_model_module(module: nn.Module) -> bool:
    """Whether the module belongs to the model, not to another module that its code applies."""
    return module.scope is not None and module.scope.has_flag(MODEL_FLAG)


def _dropout_key(module: nn.Module, method: Method) -> jax.Array | None:
    """Key for the adapter's dropout; None if dropout is off."""
    assert module.scope is not None
    if not dropout_rate(method) or not module.scope.has_flag(DROPOUT_FLAG):
        return None
    if not module.has_rng("dropout"):
        path = "/".join(module.path)
        raise ValueError(f"{path} needs 'dropout' in split_rngs of the enclosing scan or vmap")
    return module.make_rng("dropout")


def _apply(model: nn.Module, variables: Any, *args: Any, method: Any = None, **kwargs: Any) -> Any:
    """`model.apply`, with the model's scopes flagged."""

    def run(module: nn.Module, *args: Any, **kwargs: Any) -> Any:
        assert module.scope is not None
        flags = {DROPOUT_FLAG: True} if module.has_rng("dropout") else {}
        module.scope.flags = module.scope.flags.copy({MODEL_FLAG: True} | flags)
        if callable(method):
            return method(module, *args, **kwargs)
        return getattr(module, method or "__call__")(*args, **kwargs)

    return model.apply(variables, *args, method=run, **kwargs)


def _with_adapters_in_params(variables: Mapping[str, Any]) -> dict[str, Any]:
    """Copy the collection "adapters" into "params", where the model expects its parameters."""
    trained = flatten_dict(flax.core.unfreeze(validate.variables(variables).get("adapters", {})))
    params = flatten_dict(flax.core.unfreeze(variables["params"])) | trained
    return {**variables, "params": unflatten_dict(params)}
