"""Load Hugging Face PEFT adapter folders into Linen models; `hugging_face` is for NNX."""

import os
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.traverse_util import flatten_dict, unflatten_dict

from lorasp_jax.adapters.io.hugging_face import Names, dotted, match_folder
from lorasp_jax.adapters.layers.nnx_layers import Einsums
from lorasp_jax.adapters.linen import ADAPTER, LinenAdapter


def load_peft_linen(
    folder: str | os.PathLike[str],
    model: nn.Module,
    variables: Mapping[str, Any],
    *args: Any,
    names: Names = dotted,
    einsums: Einsums = MappingProxyType({}),
    **kwargs: Any,
) -> tuple[LinenAdapter, dict[str, Any]]:
    """Load the adapters of a Hugging Face PEFT folder into a Linen model.

    Args:
        folder: as for `hugging_face.load_peft`.
        model: any Linen module.
        variables: variables of the bare model, with "params"; not modified.
        *args: the model's call arguments; the model is called to find its layers.
        names: as for `hugging_face.load_peft`.
        einsums: as for `LinenAdapter`.
        **kwargs: the model's call arguments.

    Returns:
        (adapter, variables) for `adapter.apply(variables, ...)`.

    Raises:
        ValueError: as for `hugging_face.load_peft`.
    """
    bare = LinenAdapter(model, [(".*", None)], einsums)
    shapes = bare.kernel_shapes(variables, *args, **kwargs)
    flat: dict[Any, Any] = {**flatten_dict(variables["params"])}
    sizes = {"/".join(path): jnp.shape(parameter) for path, parameter in flat.items()}
    rules, values, full_values = match_folder(folder, shapes, sizes, names)
    adapter = LinenAdapter(model, rules, einsums)
    attached = adapter.attach(jax.random.key(0), variables, *args, **kwargs)
    trained: dict[Any, Any] = {**flatten_dict(attached["adapters"])}
    for path, params in values.items():
        for name, value in params.items():
            trained[(*filter(None, path.split("/")), ADAPTER, name)] = jnp.asarray(value)
    for path, value in full_values.items():
        trained[tuple(path.split("/"))] = jnp.asarray(value)
    return adapter, attached | {"adapters": unflatten_dict(trained)}
