"""The frozen base of a run: loaded from a checkpoint, or random."""

import dataclasses
from pathlib import Path
from typing import Any

from flax import nnx

import envs
from lorasp_jax import models
from lorasp_jax.config import Config
from lorasp_jax.models import backbone
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.checkpoints import loading
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.storage import hub
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run_folder import read_json

SIZES = ("nano", "small", "base", "nano_pi05", "base_pi05")
TRAINING = "training.json"
"""File beside base weights: what they were trained on, with the control period."""


def base_model(config: Config, *, shapes: bool = False) -> tuple[Backbone, str]:
    """The frozen base and its hash: loaded from the checkpoint, or random where none is named.

    Args:
        config: of the run.
        shapes: what would be drawn or downloaded is abstract, without a hash.

    Raises:
        ValueError: an unknown backbone or size, or a base of another one.
    """
    chosen, kind = config.model, backbone.find(config.model.backbone)
    sizes = [size for size in SIZES if hasattr(kind, size)]
    if chosen.size not in sizes:
        raise ValueError(f"unknown size {chosen.size!r}: it is one of {', '.join(sizes)}")
    wanted: BackboneConfig = getattr(kind, chosen.size)()
    unroll = wanted.unroll if chosen.unroll is None else chosen.unroll
    kinds = {"dtype": chosen.dtype, "param_dtype": chosen.param_dtype, "unroll": unroll}
    wanted = dataclasses.replace(wanted, **kinds)
    if not wanted.inputs.masks_missing:
        wanted = dataclasses.replace(wanted, cameras=wanted.cameras[: len(envs.Env.cameras)])
    if shapes and (not chosen.source or hub.is_remote(chosen.source)):
        return nnx.eval_shape(lambda: wanted.create(nnx.Rngs(0))), ""
    if chosen.source:
        found = loading.find(chosen.source)
        wanted = dataclasses.replace(wanted, inputs=found.inputs or wanted.inputs)
        model = found.load(wanted)
        if found.layout == "ours":
            _check_time(found.folder, config.control_dt)
        return model, models.weights_hash(model)
    model = wanted.create(nnx.Rngs(RandomStream.BASE.key(config.seed)))
    return model, models.weights_hash(model)


def changed(model: Backbone, **changes: Any) -> Backbone:
    """The same parameters in a model whose config differs in what no parameter depends on."""
    wanted = dataclasses.replace(model.config, **changes)
    if wanted == model.config:
        return model
    abstract = nnx.eval_shape(lambda: wanted.create(nnx.Rngs(0)))
    return nnx.merge(nnx.graphdef(abstract), nnx.state(model))


def _check_time(folder: Path, control_dt: float) -> None:
    """Raise ValueError unless the base in a folder was trained at this control period."""
    path = folder / TRAINING
    if "control_dt" not in (told := read_json(path)):
        raise ValueError(f"{path} does not say the control_dt that the base needs")
    found = told["control_dt"]
    if found != control_dt:
        raise ValueError(
            f"{folder} was trained with control_dt {found} s, this run has {control_dt}"
        )
