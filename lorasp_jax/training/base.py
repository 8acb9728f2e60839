"""The frozen base of a run: loaded from a checkpoint or randomly initialized."""

import dataclasses
import functools
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

import envs
from lorasp_jax import models
from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.compress import quantization
from lorasp_jax.base import hub
from lorasp_jax.config import Config, ModelConfig
from lorasp_jax.dense import AdapterParam
from lorasp_jax.models import backbone
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.checkpoints import loading, openpi_configs
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run_folder import read_json

SIZES = ("nano", "small", "medium", "base", "nano_pi05", "base_pi05")
_TOWERS = "^(vision|language|action)/"
TRAINING = "training.json"
"""File beside the base weights that describes their training, such as the control period."""


def base_model(config: Config, *, abstract: bool = False) -> tuple[Backbone, str]:
    """Return the frozen base, loaded or randomly initialized, and its hash.

    With `abstract`, a base that is remote or randomly initialized has only shapes and an empty
    hash. A base that is to be quantized stays in host memory, as NumPy arrays: the device may not
    hold it unquantized.

    Raises:
        ValueError: the backbone or size is unknown, or the checkpoint does not match the config.
    """
    options, model_config = config.model, _as_chosen(config)
    unseen = not options.source or (abstract and hub.is_remote(options.source))
    if unseen and (options.openpi_config or hub.BUCKET.fullmatch(options.source)):
        model_config = _as_trained(options, model_config)  # openpi's are in buckets
    if unseen and abstract:
        return nnx.eval_shape(lambda: model_config.create(nnx.Rngs(0))), ""
    if options.source:
        checkpoint = loading.find(options.source)
        if checkpoint.is_openpi:
            model_config = checkpoint.resized(model_config)
            trained = _as_trained(options, model_config, has_chunk=checkpoint.records_lengths)
            model_config = checkpoint.resized(trained)
        elif options.openpi_config:
            raise ValueError(
                f"--model.openpi-config is for checkpoints of openpi, and {options.source} is none"
            )
        model_config = _as_recorded(options, model_config, checkpoint)
        make = functools.partial(checkpoint.load, model_config)
        # Actions of recordings may mean anything, and a base can learn another period from them.
        if checkpoint.layout == "ours" and not config.data.source:
            _check_control_dt(checkpoint.folder, config.control_dt)
    else:
        make = functools.partial(_random, model_config, config.seed)
    model = on_host(make) if options.base_dtype else make()
    return model, models.weights_hash(model)


def _as_chosen(config: Config) -> BackboneConfig:
    """Return the backbone of the size and types that the settings say."""
    options = config.model
    model_config = sized(options.backbone, options.size)
    model_config = dataclasses.replace(
        model_config,
        dtype=options.dtype,
        param_dtype=options.param_dtype,
        unroll=model_config.unroll if options.unroll is None else options.unroll,
    )
    if model_config.inputs.masks_missing or config.data.source:  # see `setup.build`
        return model_config
    cameras = model_config.cameras[: len(envs.Env.cameras)]
    return dataclasses.replace(model_config, cameras=cameras)


def _random(config: BackboneConfig, seed: int) -> Backbone:
    return config.create(nnx.Rngs(RandomStream.BASE.key(seed)))


def _as_trained(
    options: ModelConfig, config: BackboneConfig, *, has_chunk: bool = False
) -> BackboneConfig:
    """Return the config of an openpi checkpoint as its training config says; print what is taken.

    With `has_chunk`, the files say how long the chunk is.

    Raises:
        ValueError: the training config is unknown, or of another model.
    """
    name, where = options.openpi_config, options.source
    if name == "none":
        return config
    if named := openpi_configs.find(name) if name else openpi_configs.guess(where):
        return named.apply(config)
    assumed = [f"chunks of {config.chunk}"] * (not options.chunk and not has_chunk)
    assumed += ["absolute actions"] * (options.relative_actions is None)
    assumed += ["the state in prompts"] * config.inputs.prompt_state
    if assumed:
        print(
            f"the files of {where} do not say how it was trained: taking {', '.join(assumed)}; "
            "--model.openpi-config names its training config",
            file=sys.stderr,
        )
    return config


def _as_recorded(
    options: ModelConfig, config: BackboneConfig, checkpoint: loading.ModelFolder
) -> BackboneConfig:
    """Return the config with inputs and chunk of a LeRobot policy's files; print the chunk."""
    chunk = checkpoint.chunk or config.chunk
    if checkpoint.chunk and not options.chunk:
        print(
            f"{options.source} was trained with chunks of {chunk}, as its config.json says: "
            "--model.chunk chooses another length",
            file=sys.stderr,
        )
    return dataclasses.replace(config, inputs=checkpoint.inputs or config.inputs, chunk=chunk)


def on_host(make: Callable[[], Backbone]) -> Backbone:
    """Return the model that `make` loads or creates, as NumPy arrays, for `quantized`.

    Raises:
        ValueError: JAX_PLATFORMS leaves out the CPU.
    """
    try:
        host = jax.local_devices(backend="cpu")[0]
    except RuntimeError as error:
        platforms = jax.config.jax_platforms  # type: ignore[attr-defined]
        raise ValueError(
            f"the base is quantized from host memory, which JAX_PLATFORMS={platforms} leaves out: "
            f"set JAX_PLATFORMS={platforms},cpu"
        ) from error
    with jax.default_device(host):
        graphdef, state = nnx.split(make())
    return nnx.merge(graphdef, jax.tree.map(np.asarray, state))


def sized(name: str, size: str) -> BackboneConfig:
    """Return the config of a size of a backbone; raise ValueError if there is none."""
    found = backbone.find(name)
    sizes = [each for each in SIZES if hasattr(found, each)]
    if size not in sizes:
        raise ValueError(f"unknown size {size!r}: choose one of {', '.join(sizes)}")
    return getattr(found, size)()


def with_config(model: Backbone, **changes: Any) -> Backbone:
    """Return the model with changed config fields, which must not affect its parameters."""
    model_config = dataclasses.replace(model.config, **changes)
    if model_config == model.config:
        return model
    abstract = nnx.eval_shape(lambda: model_config.create(nnx.Rngs(0)))
    return nnx.merge(nnx.graphdef(abstract), nnx.state(model))


def quantized(model: Any, kind: quantization.Kind | Literal[""] | None) -> Any:
    """Return the model with the layers of its three towers quantized, or unchanged if no `kind`.

    Layers that are trained in full stay as they are. A base in host memory goes to the device when
    all of it is quantized: full-size kernels, once freed, would leave gaps between its arrays, and
    XLA needs its temporary memory in one piece. For the same reason, adapters then stay in host
    memory, since training copies them.
    """
    if not kind:
        return model
    trained = paths.locate(nnx.List([model]), AdapterParam)
    kept = [location.path.rpartition("/")[0] for location in trained if location.name == "kernel"]
    rules = [(f"^{re.escape(path)}$", None) for path in kept]
    graphdef, adapters, frozen = adaptation.split(
        quantization.quantize(model, [*rules, (_TOWERS, kind)]).model
    )
    if any(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(frozen)):
        del model, trained  # which hold adapters on the device
        adapters = jax.device_get(adapters)
        frozen = jax.tree.map(jnp.asarray, frozen)
    return nnx.merge(graphdef, adapters, frozen)


def in_bf16(model: Any) -> Any:
    """Return the model with its frozen weights rounded to bf16, as they are saved."""
    graphdef, adapters, frozen = adaptation.split(model)
    is_kernel = lambda leaf: isinstance(leaf, quantization.QuantizedKernel)  # noqa: E731
    frozen = jax.tree.map(lambda leaf: leaf.astype(jnp.bfloat16), frozen, is_leaf=is_kernel)
    model = nnx.merge(graphdef, adapters, frozen)
    model.config = dataclasses.replace(model.config, param_dtype="bfloat16")
    return model


def _check_control_dt(folder: Path, control_dt: float) -> None:
    """Raise ValueError unless the base in `folder` was trained with this control period."""
    path = folder / TRAINING
    if "control_dt" not in (training := read_json(path)):
        raise ValueError(f"{path} is missing or lacks control_dt, the control period of the base")
    trained = training["control_dt"]
    if trained != control_dt:
        raise ValueError(
            f"{folder} was trained with control_dt {trained} s, but this run has {control_dt} s"
        )
