"""Load and save Hugging Face PEFT adapter folders: LoRA, rsLoRA, DoRA and pruned AdaLoRA.

A folder has adapter_config.json and adapter_model.safetensors, with tensors named
base_model.model.<module>.lora_A.weight etc., in torch's layout `[out, in]` (format of PEFT 0.21.2).
"""

import collections
import json
import os
import pathlib
import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from flax import nnx

from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.io.peft_folders import (
    CONFIG,
    PREFIX,
    TENSORS,
    Adapter,
    read_folder,
    to_torch,
)
from lorasp_jax.adapters.io.peft_full import (
    Names,
    base_parameters,
    check_biases,
    check_saved,
    export_full_parameters,
)
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.base.writing import write_bytes, write_text
from lorasp_jax.dense import AdaptedLayer, AdapterParam, validate
from lorasp_jax.kernels.quantized_weights import QuantizedKernel
from lorasp_jax.peft import AdaLoRA, DoRA, FullFineTuning, LoRA
from lorasp_jax.peft.fields import short
from lorasp_jax.peft.method import dropout_rate


def dotted(path: str, index: tuple[int, ...]) -> str:
    """Default module name, for models whose attribute names match torch's.

    Raises:
        ValueError: the layer is in a stack, so its name cannot be guessed.
    """
    if index:
        raise ValueError(f"{path} is a stack: pass names=, a function (path, index) -> name")
    return path.replace("/", ".")


def checked_names(names: Names) -> Names:
    """Wrap `names` to raise ValueError for duplicate names."""
    layer_of: dict[str, tuple[str, tuple[int, ...]]] = {}

    def checked(path: str, index: tuple[int, ...]) -> str:
        name = names(path, index)
        if (first := layer_of.setdefault(name, (path, index))) != (path, index):
            raise ValueError(f"names returns {short(name)} for both {first} and {(path, index)}")
        return name

    return checked


def load_peft(
    folder: str | os.PathLike[str],
    model: adaptation.Model,
    *,
    names: Names = dotted,
    einsums: nnx_layers.Einsums = MappingProxyType({}),
) -> adaptation.Model:
    """Load the adapters of a Hugging Face PEFT folder into a model.

    Adapters apply to dense layers and einsums, including those of `nnx.MultiHeadAttention`, whose
    heads are concatenated as in torch, and LoRA also to embeddings and convolutions. Biases and
    modules that PEFT trained in full (`bias`, `modules_to_save`) become trainable parameters.
    Embeddings and output layers that it only stored (`save_embedding_layers`) replace the model's.
    AdaLoRA is loaded as the equivalent LoRA. If ranks differ within a stack, or some of its layers
    have no adapter, the method has `ranks`. `lora_dropout` becomes the methods' `dropout`, which
    is active only under `with_dropout`.

    The adapter of an `nnx.Embed` also changes the logits of its `attend`. In PEFT, that of an
    embedding changes the logits only with `ensure_weight_tying`.

    Args:
        folder: local folder with adapter_config.json and adapter_model.safetensors, or a Hub
            repository hf://owner/name, from which only these two files are downloaded.
        model: not modified; its adapters on other layers are kept.
        names: function (path, index) -> PEFT's module name. The path is "/"-joined; the index is a
            tuple with the position along each axis of a scanned stack, () for a layer in none. By
            default, "a/0/b" becomes "a.0.b", and stacks are refused.
        einsums: as for `adapt`.

    Raises:
        ValueError: files are missing or damaged, the adapter type is not supported, the model lacks
            a module, or an adapter does not fit its layer.
    """
    nnx_layers.check_einsums(einsums)
    root = nnx.List([validate.module(model)])
    folder, names = _local_folder(folder), checked_names(names)
    shapes = {
        location.path: nnx_layers.matrices_shape(location.child, einsums)
        for location in paths.locate_layers(root, einsums)
    }
    parameters = [p for p in paths.locate(root, nnx.Param) if p.name != "adapter"]
    sizes = {location.path: location.child.get_value().shape for location in parameters}
    others = paths.unsupported_classes(root, einsums)
    rules, values, full_values = _match_folder(folder, shapes, sizes, others, names)
    with paths.naming("load", folder):
        adapted = adaptation.adapt(model, rules, rngs=nnx.Rngs(0), einsums=einsums)
    for location in paths.locate(nnx.List([adapted]), nnx.Param):
        if location.path in full_values:
            old = location.child.get_value()
            if isinstance(old, QuantizedKernel):
                raise ValueError(f"{folder} replaces {location.path}: quantize after loading it")
            location.child.set_value(jnp.asarray(full_values[location.path], old.dtype))
    for location in paths.locate(nnx.List([adapted]), AdaptedLayer):
        if location.path in values:
            location.child.adapter.set_value(jax.tree.map(jnp.asarray, values[location.path]))
    return adapted


def _match_folder(
    folder: pathlib.Path,
    shapes: Mapping[str, Sequence[int]],
    sizes: Mapping[str, Sequence[int]],
    others: Mapping[str, str],
    names: Names,
) -> tuple[paths.Rules, dict[str, Adapter], Adapter]:
    """Match a folder against the kernel matrices `[..., I, O]` and the parameters of a model.

    `others` maps the paths of modules that adapters do not support to their class names.

    Returns rules for `adapt`, the adapters' parameters by path, and the values of base parameters,
    trained or not, by path.
    """
    contents = read_folder(folder)
    config, unused = contents.config, dict(contents.adapters)
    kind, dropout = DoRA if config.get("use_dora") else LoRA, config.get("lora_dropout") or 0.0
    candidates, rules, values = [], [], {}
    for path, (*leading, d_in, d_out) in shapes.items():
        module_names = [names(path, index) for index in np.ndindex(*leading)]
        candidates += module_names
        present = {name: unused.pop(name) for name in module_names if name in unused}
        if not present:
            continue
        if len(present) < len(module_names) and kind is DoRA:
            raise ValueError(f"{folder} adapts only some layers of the stack {path} with DoRA")
        for name, adapter in present.items():
            _check_fits(folder, name, adapter, d_in, d_out)
        first = next(iter(present.values()))
        blank = {**first, "lora_a": first["lora_a"][:, :0], "lora_b": first["lora_b"][:0]}
        adapters = [present.get(name, blank) for name in module_names]
        scale, values[path] = _stacked(adapters, leading)
        rank = values[path]["lora_a"].shape[-1]
        ranks = tuple(adapter["lora_a"].shape[-1] for adapter in adapters)
        ranks = ranks if min(ranks) < max(ranks) else ()
        with paths.naming("load", folder):
            method = kind(rank, scale * rank, dropout=dropout, ranks=ranks)
            rules.append((f"^{re.escape(path)}$", method))
    if not contents.adapters:
        raise ValueError(f"{folder} contains no adapters")
    if effective := sorted(name for name, adapter in unused.items() if _has_effect(adapter)):
        known = paths.available_layers(effective[0], candidates, others)
        raise ValueError(
            f"{folder} adapts {short(effective[0])}, the name of no layer that adapters support; "
            f"{known}"
        )
    check_biases(folder, config.get("bias") or "none", contents.trained, sizes, values)
    check_saved(folder, config.get("modules_to_save") or (), contents.trained, candidates)
    trained, frozen = base_parameters(folder, contents, shapes, sizes, names)
    # These rules come first, since the bias of an adapted layer may be fully fine-tuned.
    full_rules = [(f"^{re.escape(path)}$", FullFineTuning()) for path in trained]
    return [*full_rules, *rules], values, trained | frozen


def _has_effect(adapter: Adapter) -> bool:
    """Whether an adapter changes its layer. Those of unused layers stay at zero in training."""
    return "magnitude" in adapter or bool(adapter["lora_a"].any() and adapter["lora_b"].any())


def _local_folder(folder: str | os.PathLike[str]) -> pathlib.Path:
    """Return the folder's local path, after downloading a repository hf://owner/name."""
    if not isinstance(folder, str) or "://" not in folder:
        return validate.folder(folder)
    from lorasp_jax.base import hub

    return hub.local(folder, only=[CONFIG, TENSORS])


def save_peft(
    folder: str | os.PathLike[str],
    model: nnx.Module,
    *,
    names: Names = dotted,
    base: str | None = None,
) -> None:
    """Save the adapters of a model as a Hugging Face PEFT folder.

    AdaLoRA is saved as the equivalent LoRA, without pruned directions. Layers of a stack are saved
    with their own `ranks`, and not at all if the rank is 0.

    Args:
        folder: created if absent; an adapter in it is replaced.
        model: adapted with LoRA, AdaLoRA or both, or with DoRA only. Fully fine-tuned parameters
            become PEFT's `bias` and `modules_to_save`.
        names: as for `load_peft`; called with ("blocks/q_proj", (0,)), ("blocks/q_proj", (1,)), ...
            for a stack, and with ("head", ()) for a layer in none.
        base: value of base_model_name_or_path.

    Raises:
        ValueError: there are no adapters, PEFT does not support one of them, LoRA and DoRA are
            mixed, or the dropout rates differ.
    """
    folder, names = validate.folder(folder), checked_names(names)
    validate.with_values(model)
    if not (layers := _supported_layers(model)):
        raise ValueError("a PEFT folder needs a layer with LoRA, but the model has none")
    settings = {(isinstance(x.method, DoRA), dropout_rate(x.method)) for x in layers.values()}
    if len(settings) != 1:
        raise ValueError(f"PEFT needs one use_dora and lora_dropout, got {sorted(settings)}")
    ((use_dora, lora_dropout),) = settings
    modules = {
        names(path, index): _to_peft(layer, index)
        for path, layer in layers.items()
        for index in np.ndindex(*layer.kernel_matrices().shape[:-2])
        if use_dora or _rank(layer, index) != 0
    }
    tensors = {
        f"{PREFIX}{module}.{name}": value
        for module, (_, adapter) in modules.items()
        for name, value in adapter.items()
    }
    full_values, config = export_full_parameters(model, layers, names)
    config = _config(modules, base) | config
    config |= {"use_dora": use_dora, "lora_dropout": lora_dropout}
    folder.mkdir(parents=True, exist_ok=True)
    data = safetensors.numpy.save(tensors | full_values, {"format": "pt"})
    write_bytes(folder / TENSORS, data)
    write_text(folder / CONFIG, json.dumps(config, indent=2))


def _supported_layers(model: nnx.Module) -> dict[str, AdaptedLayer]:
    """Adapted layers by path; raise ValueError for one that PEFT does not support."""
    layers = {}
    for path, _, _, layer in paths.locate(nnx.List([model]), AdaptedLayer):
        if not isinstance(layer.adapter, AdapterParam):
            continue
        if not isinstance(layer.method, LoRA | AdaLoRA):
            raise ValueError(
                f"{path} uses {layer.method.name}, which Hugging Face PEFT does not support"
            )
        if layer.method.splits_kernel:
            raise ValueError(f"the adapter of {path} split the kernel: merge it instead")
        layers[path] = layer
    return layers


def _check_fits(folder: pathlib.Path, module: str, adapter: Adapter, d_in: int, d_out: int) -> None:
    """Raise ValueError unless the adapter's shapes match a kernel `[I, O]`."""
    a, b = adapter["lora_a"].shape, adapter["lora_b"].shape
    rank = a[-1]
    if (a, b) != ((d_in, rank), (rank, d_out)):
        raise ValueError(f"{folder}: {module} has shapes {a} and {b} for a {d_in}x{d_out} kernel")


def _stacked(adapters: list[Adapter], leading: list[int]) -> tuple[float, Adapter]:
    """Stack adapters, rescaled to a common scale and zero-padded to a common rank."""
    rank, scale = max(1, *(a["lora_a"].shape[1] for a in adapters)), float(adapters[0]["scale"])

    def padded(adapter: Adapter) -> Adapter:
        padding = rank - adapter["lora_a"].shape[1]
        ratio = float(adapter["scale"]) / scale
        return {
            "lora_a": np.pad(adapter["lora_a"], ((0, 0), (0, padding))),
            "lora_b": np.pad(adapter["lora_b"] * np.float32(ratio), ((0, padding), (0, 0))),
        } | {name: adapter[name] for name in ("magnitude",) if name in adapter}

    padded_adapters = [padded(adapter) for adapter in adapters]
    stacked = {name: np.stack([a[name] for a in padded_adapters]) for name in padded_adapters[0]}
    return scale, {name: x.reshape(*leading, *x.shape[1:]) for name, x in stacked.items()}


def _rank(layer: AdaptedLayer, index: tuple[int, ...]) -> int | None:
    """The rank of one layer of a stack, or None if all have the rank of the method."""
    ranks = getattr(layer.method, "ranks", ())
    return int(np.reshape(ranks, layer.stack_shape())[index]) if ranks else None


def _to_peft(layer: AdaptedLayer, index: tuple[int, ...]) -> tuple[float, Adapter]:
    """Scale and tensors of one module, with PEFT's names and layout."""
    assert layer.adapter is not None
    params = {k: np.asarray(v[index], np.float32) for k, v in layer.adapter.get_value().items()}
    a, b = params["lora_a"], params["lora_b"]
    if (rank := _rank(layer, index)) is not None:
        a, b = a[:, : max(rank, 1)], b[: max(rank, 1)]  # PEFT needs a rank of at least 1
    if isinstance(layer.method, AdaLoRA):
        active = np.flatnonzero(params["lora_e"])
        active = active if len(active) else np.array([0])
        a, b = (a * params["lora_e"])[:, active], b[active]
    if isinstance(layer, nnx_layers.ConvLayer):
        sizes = layer.kernel_size  # pyright: ignore[reportAttributeAccessIssue]
        a, b = a.reshape(*sizes, -1, a.shape[-1]), b.reshape(*(1 for _ in sizes), *b.shape)
    name = "lora_embedding_{}" if isinstance(layer, nnx_layers.EmbedLayer) else "lora_{}.weight"
    tensors = {name.format("A"): to_torch(a), name.format("B"): to_torch(b)}
    if "magnitude" in params:
        tensors["lora_magnitude_vector"] = params["magnitude"]
    return layer.method.scale, tensors  # pyright: ignore[reportAttributeAccessIssue, reportOptionalMemberAccess]


def _config(modules: Mapping[str, tuple[float, Adapter]], base: str | None) -> dict[str, Any]:
    """Fields of adapter_config.json: the most common rank and α, and patterns for the others."""
    ranks = {name: len(next(iter(adapter.values()))) for name, (_, adapter) in modules.items()}
    alphas = {name: scale * ranks[name] for name, (scale, _) in modules.items()}
    rank, alpha = (collections.Counter(x.values()).most_common(1)[0][0] for x in (ranks, alphas))
    return {
        "peft_type": "LORA",
        "base_model_name_or_path": base,
        "r": rank,
        "lora_alpha": alpha,
        # Without the ^, a key would also match longer names that end with this name.
        "rank_pattern": {f"^{re.escape(n)}": r for n, r in ranks.items() if r != rank},
        "alpha_pattern": {f"^{re.escape(n)}": a for n, a in alphas.items() if a != alpha},
        "target_modules": sorted(modules),
        "use_rslora": False,
        "fan_in_fan_out": False,
        "inference_mode": True,
        "task_type": None,
    }
