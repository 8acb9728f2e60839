"""Adapter folders of Hugging Face PEFT, in and out: LoRA, rsLoRA, DoRA, and AdaLoRA once pruned.

Such a folder holds adapter_config.json and adapter_model.safetensors, whose tensors are named
base_model.model.<module>.lora_A.weight and so on, with torch's layout [out, in]. Which module is
which layer of a model says a function of the layer's path and its index in a scanned stack; without
one, "a/0/b" is "a.0.b". (Format as PEFT 0.21.2 writes it.)
"""

import collections
import json
import os
import pathlib
import re
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from flax import nnx

from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.io.native import write_whole
from lorasp_jax.adapters.io.peft_folders import CONFIG, PREFIX, TENSORS, Adapter, read
from lorasp_jax.adapters.io.peft_whole import Names, check_biases, exported_whole, whole_parameters
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.dense import AdaptedLayer, AdapterParam, validate
from lorasp_jax.peft import AdaLoRA, DoRA, FullFineTuning, LoRA
from lorasp_jax.peft._fields import short
from lorasp_jax.peft._method import dropout_rate


def dotted(path: str, index: tuple[int, ...]) -> str:
    """The module's name where a model's attributes are called as in torch.

    Raises:
      ValueError: for a layer of a stack, whose name cannot be guessed.
    """
    if index:
        raise ValueError(f"{path} is a stack of layers: give names(path, index) for its modules.")
    return path.replace("/", ".")


def distinct(names: Names) -> Names:
    """The same function, which now raises a ValueError for what it gives that is no name, and for
    one name of two layers."""
    if not callable(names):
        raise ValueError(f"names is a function of a path and an index, got {short(names)}.")
    layer_of: dict[str, tuple[str, tuple[int, ...]]] = {}

    def checked(path: str, index: tuple[int, ...]) -> str:
        name = names(path, index)
        if not isinstance(name, str) or not name:
            raise ValueError(f"names must give a text for {path!r}, {index}, got {short(name)}.")
        if (first := layer_of.setdefault(name, (path, index))) != (path, index):
            raise ValueError(f"names gives {short(name)} for {first} and for {(path, index)}.")
        return name

    return checked


def load_peft(
    folder: str | os.PathLike[str],
    model: adaptation.Model,
    *,
    names: Names = dotted,
    einsums: nnx_layers.Einsums = MappingProxyType({}),
) -> adaptation.Model:
    """The model with the adapters of a folder of Hugging Face PEFT.

    Biases and modules that the folder trained in full (`bias`, `modules_to_save`) train in full
    here, too. Adapters go to dense layers and einsums, `nnx.MultiHeadAttention`'s among them, whose
    kernels stand for torch's with all heads side by side. AdaLoRA comes as the LoRA that it has
    become. Zeros make up for different ranks in a stack. `lora_dropout` is the methods' `dropout`,
    which is off but for `with_dropout`.

    Args:
      folder: with adapter_config.json and adapter_model.safetensors; or a repository on the hub,
        hf://owner/name, of which only these two files are fetched.
      model: not modified; adapters that it has elsewhere than the folder stay.
      names: module of the layer at a path and an index in its stack, () outside of stacks.
      einsums: as for `adapt`.

    Raises:
      ValueError: missing or damaged files, an adapter of another kind, modules that the model does
        not have, or adapters that do not fit their layers.
    """
    nnx_layers.check_einsums(einsums)
    root = nnx.List([validate.module(model)])
    shapes = {
        location.path: nnx_layers.matrices_shape(location.child, einsums)
        for location in paths.locate_matmul_layers(root, einsums)
    }
    parameters = [p for p in paths.locate(root, nnx.Param) if p.name != "adapter"]
    sizes = {location.path: location.child.get_value().shape for location in parameters}
    rules, values, whole = matched(folder, shapes, sizes, names)
    adapted = adaptation.adapt(model, rules, rngs=nnx.Rngs(0), einsums=einsums)
    for location in paths.locate(nnx.List([adapted]), AdapterParam):
        if location.path in whole:
            location.child.set_value(jnp.asarray(whole[location.path]))
    for location in paths.locate(nnx.List([adapted]), AdaptedLayer):
        if location.path in values:
            location.child.adapter.set_value(jax.tree.map(jnp.asarray, values[location.path]))
    return adapted


def matched(
    folder: str | os.PathLike[str],
    shapes: Mapping[str, Sequence[int]],
    sizes: Mapping[str, Sequence[int]],
    names: Names,
) -> tuple[paths.Rules, dict[str, Adapter], Adapter]:
    """The rules that give a model what is in a folder, and by path the parameters of its adapters
    and those that it trained in full.

    Args:
      folder: as for `load_peft`.
      shapes: by path of a layer, [..., I, O] of its kernel matrices.
      sizes: by path of a parameter, its shape.
      names: as for `load_peft`.

    Raises:
      ValueError: as for `load_peft`.
    """
    folder, names = _at_hand(folder), distinct(names)
    config, modules, full = read(folder)
    kind = DoRA if config.get("use_dora") else LoRA
    dropout = config.get("lora_dropout") or 0.0
    left, known, rules, values = dict(modules), [], [], {}
    for path, (*leading, d_in, d_out) in shapes.items():
        wanted = [names(path, index) for index in np.ndindex(*leading)]
        known += wanted
        found = [left.pop(name) for name in wanted if name in left]
        if not found:
            continue
        if len(found) < len(wanted):
            raise ValueError(f"{folder} adapts only some of the layers of the stack {path}.")
        for name, adapter in zip(wanted, found, strict=True):
            _check_fits(folder, name, adapter, d_in, d_out)
        scale, values[path] = _stacked(found, leading)
        rank = values[path]["lora_a"].shape[-1]
        rules.append((f"^{re.escape(path)}$", kind(rank, scale * rank, dropout=dropout)))
    _check_used(folder, modules, left, known)
    check_biases(folder, config.get("bias", "none"), full, sizes, values)
    whole = whole_parameters(folder, full, shapes, sizes, names)
    # Of a layer with an adapter the bias may train in full: such rules go first.
    free = [(f"^{re.escape(path)}$", FullFineTuning()) for path in whole]
    return [*free, *rules], values, whole


def _at_hand(folder: str | os.PathLike[str]) -> pathlib.Path:
    """The folder on this machine; only what begins with hf:// is asked of the hub."""
    if not isinstance(folder, str) or "://" not in folder:
        return validate.folder(folder)
    from lorasp_jax.storage import hub

    return hub.local(folder, only=[CONFIG, TENSORS])


def save_peft(
    folder: str | os.PathLike[str],
    model: nnx.Module,
    *,
    names: Names = dotted,
    base: str | None = None,
) -> None:
    """Writes the adapters of a model as a folder of Hugging Face PEFT.

    AdaLoRA is written as the LoRA that it has become, pruned directions left out.

    Args:
      folder: made if absent; an adapter in it is replaced.
      model: adapted by LoRA and AdaLoRA, or by DoRA; what trains in full, too, becomes PEFT's
        `bias` and `modules_to_save`.
      names: as for `load_peft`.
      base: what the folder says of its base model.

    Raises:
      ValueError: adapters that PEFT has no counterpart for, LoRA and DoRA together, or several
        rates of dropout.
    """
    folder, names = validate.folder(folder), distinct(names)
    validate.with_values(model)
    if not isinstance(base, str | None):
        raise ValueError(f"base must be a text, the name of the base, got {short(base)}.")
    modules: dict[str, tuple[float, Adapter]] = {}
    kinds, rates = set(), set()
    methods = adaptation.methods(model).items()
    known = {p for p, method in methods if not method.trains_base and _is_known(p, method)}
    for location in paths.locate(nnx.List([model]), AdaptedLayer):
        if location.path in known:
            if isinstance(location.child, nnx_layers.LoRALayer):
                raise ValueError(
                    f"{location.path} is neither dense nor an einsum, so PEFT cannot store it."
                )
            kinds.add(isinstance(location.child.method, DoRA))
            rates.add(dropout_rate(location.child.method))
            shape = location.child.kernel_matrices().shape[:-2]
            for index in np.ndindex(*shape):
                modules[names(location.path, index)] = _exported(location.child, index)
    if len(kinds) != 1:
        raise ValueError("a PEFT folder holds either LoRA or DoRA, and at least one adapter.")
    if len(rates) != 1:
        raise ValueError(
            f"a PEFT folder has one lora_dropout, the adapters have {sorted(rates)}: give their "
            "layers one, as in layer.method = dataclasses.replace(layer.method, dropout=0.1)."
        )
    tensors = {
        f"{PREFIX}{module}.{name}": value
        for module, (_, adapter) in modules.items()
        for name, value in adapter.items()
    }
    whole, said = exported_whole(model, known, names)
    data = safetensors.numpy.save(tensors | whole, {"format": "pt"})
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / TENSORS, data)
    said |= {"use_dora": kinds.pop(), "lora_dropout": rates.pop()}
    text = json.dumps(_config(modules, base) | said, indent=2)
    write_whole(folder / CONFIG, text.encode())


def _check_fits(folder: pathlib.Path, module: str, adapter: Adapter, d_in: int, d_out: int) -> None:
    """Raises a ValueError unless a kernel [I, O] can carry the adapter."""
    a, b = adapter["lora_a"].shape, adapter["lora_b"].shape
    rank = a[-1]
    magnitude = adapter.get("magnitude", np.empty(d_out)).shape
    if (a, b, magnitude) != ((d_in, rank), (rank, d_out), (d_out,)):
        raise ValueError(
            f"{folder} adapts {module} by arrays {a} and {b}, the model's kernel is {d_in}x{d_out}."
        )


def _check_used(
    folder: pathlib.Path, modules: Collection[str], left: Collection[str], known: list[str]
) -> None:
    """Raises a ValueError unless there are modules and none is left that the model lacks."""
    if not modules:
        raise ValueError(f"{folder} adapts nothing.")
    if left:
        close = paths.near_misses(min(left), known)
        raise ValueError(
            f"{folder} adapts {short(min(left))}, which the model lacks; it has {close}."
        )


def _stacked(found: list[Adapter], leading: list[int]) -> tuple[float, Adapter]:
    """One scale, and parameters of one rank with the stack's leading axes."""
    rank, scale = max(1, *(a["lora_a"].shape[1] for a in found)), float(found[0]["scale"])

    def padded(adapter: Adapter) -> Adapter:
        room = rank - adapter["lora_a"].shape[1]
        ratio = float(adapter["scale"]) / scale
        return {
            "lora_a": np.pad(adapter["lora_a"], ((0, 0), (0, room))),
            "lora_b": np.pad(adapter["lora_b"] * np.float32(ratio), ((0, room), (0, 0))),
        } | {name: adapter[name] for name in ("magnitude",) if name in adapter}

    same = [padded(adapter) for adapter in found]
    stacked = {name: np.stack([a[name] for a in same]) for name in same[0]}
    return scale, {name: x.reshape(*leading, *x.shape[1:]) for name, x in stacked.items()}


def _is_known(path: str, method: Any) -> bool:
    """Raises a ValueError for a method that PEFT does not have."""
    if not isinstance(method, LoRA | AdaLoRA):
        raise ValueError(f"{path} has {method.name}, which Hugging Face PEFT does not know.")
    if method.splits_kernel:
        raise ValueError(
            f"the adapter of {path} split the kernel, so it cannot be used with another base: "
            "merge the adapter instead."
        )
    return True


def _exported(layer: AdaptedLayer, index: tuple[int, ...]) -> tuple[float, Adapter]:
    """Scale and tensors of one module, in PEFT's names and layout."""
    assert layer.adapter is not None
    params = {k: np.asarray(v[index], np.float32) for k, v in layer.adapter.get_value().items()}
    a, b = params["lora_a"], params["lora_b"]
    if isinstance(layer.method, AdaLoRA):
        kept = np.flatnonzero(params["lora_e"])
        kept = kept if len(kept) else np.array([0])  # PEFT needs a rank of at least 1
        a, b = (a * params["lora_e"])[:, kept], b[kept]
    tensors = {
        "lora_A.weight": np.ascontiguousarray(a.T),
        "lora_B.weight": np.ascontiguousarray(b.T),
    }
    if "magnitude" in params:
        tensors["lora_magnitude_vector"] = params["magnitude"]
    return layer.method.scale, tensors  # pyright: ignore[reportAttributeAccessIssue, reportOptionalMemberAccess]


def _config(modules: Mapping[str, tuple[float, Adapter]], base: str | None) -> dict[str, Any]:
    """Most of adapter_config.json: one rank and α for most, patterns for the others."""
    ranks = {name: len(found["lora_A.weight"]) for name, (_, found) in modules.items()}
    alphas = {name: scale * ranks[name] for name, (scale, _) in modules.items()}
    rank, alpha = (collections.Counter(x.values()).most_common(1)[0][0] for x in (ranks, alphas))
    return {
        "peft_type": "LORA",
        "base_model_name_or_path": base,
        "r": rank,
        "lora_alpha": alpha,
        # Without the ^ a key would also match longer names that end in it.
        "rank_pattern": {f"^{re.escape(n)}": r for n, r in ranks.items() if r != rank},
        "alpha_pattern": {f"^{re.escape(n)}": a for n, a in alphas.items() if a != alpha},
        "target_modules": sorted(modules),
        "use_rslora": False,
        "fan_in_fan_out": False,
        "inference_mode": True,
        "task_type": None,
    }
