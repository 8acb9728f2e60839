"""Load a model from a local folder, the Hugging Face Hub or a bucket, in any known layout."""

import dataclasses
import functools
import logging
import os
from pathlib import Path
from typing import Any, Literal

from lorasp_jax.adapters.io import hugging_face
from lorasp_jax.base import hub, json_values
from lorasp_jax.base.files import as_value_error, read_json
from lorasp_jax.models import backbone
from lorasp_jax.models.checkpoints import lerobot_config, native, openpi_configs, published
from lorasp_jax.models.checkpoints.layouts import ModelMismatchError
from lorasp_jax.models.checkpoints.tensor_files import INDEX, SINGLE, TensorFiles, weight_files
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.inputs import InputConfig
from lorasp_jax.models.pi0 import lerobot as pi0_files

_log = logging.getLogger(__name__)
_DEPTHS = ("*", "*/*", "checkpoints/*/pretrained_model")  # where an experiment's models are
_PARTS = (SINGLE, INDEX, hugging_face.TENSORS, f"params/{published.METADATA}")
_UNFINISHED = "orbax-checkpoint-tmp"  # in the name of a folder that Orbax is writing

Layout = Literal["ours", "openpi", "lerobot"]


@dataclasses.dataclass(frozen=True)
class ModelFolder:
    """A local model folder, inspected once.

    Attributes:
        folder: its path.
        layout: "ours" (this project's config.json), "openpi" (Orbax folder `params`) or, for any
            other folder, "lerobot" (safetensors with LeRobot's names: a policy of LeRobot, whose
            config.json has the policy type, or openpi's PyTorch conversion).
        fields: contents of config.json and, for LeRobot's, of its preprocessor; empty if there is
            no such file.
        source: where the folder comes from.
    """

    folder: Path
    layout: Layout
    fields: dict[str, Any] = dataclasses.field(repr=False)
    source: str = ""

    @property
    def is_openpi(self) -> bool:
        """Whether the files have weights and say little else, as openpi's and conversions do."""
        untyped = self.layout == "lerobot" and "type" not in self.fields
        says_little = self.records_lengths or _has_weights(self.folder)
        return self.layout == "openpi" or (untyped and says_little)

    @property
    def records_lengths(self) -> bool:
        """Whether config.json is that of openpi's PyTorch conversion, with sizes and chunk."""
        return pi0_files.is_conversion(self.fields)

    @property
    def robot_cameras(self) -> dict[str, str]:
        """The model's cameras and the robot's names for them; empty: the files do not say."""
        if self.layout != "lerobot" or "type" not in self.fields:
            return {}
        with as_value_error(self.folder / lerobot_config.PREPROCESSOR):
            return lerobot_config.robot_cameras(self.fields, self.config.cameras)

    @functools.cached_property
    def config(self) -> BackboneConfig:
        """The config that `load` uses if none is passed; no weights are read.

        That of a checkpoint of openpi is the training config that it is named after.

        Raises:
            ValueError: the folder does not specify sizes, or its model is not supported.
        """
        if self.layout == "ours":
            return native.load_config(self.folder)
        if self.is_openpi and (named := openpi_configs.guess(self.source)):
            return self.resized(named.config)
        if self.layout == "openpi":
            return backbone.find("pi0").base()
        return _lerobot_config(self.folder, self.fields)

    def resized(self, config: BackboneConfig) -> BackboneConfig:
        """Return a config with the lengths that openpi's PyTorch conversions record.

        Raises:
            ValueError: the folder records all sizes itself.
        """
        if self.layout == "ours" or "type" in self.fields:
            raise ValueError(f"{self.folder / native.CONFIG} records the sizes: leave out --size")
        with as_value_error(self.folder / native.CONFIG):
            return pi0_files.with_lengths(config, self.fields)

    @property
    def inputs(self) -> InputConfig | None:
        """Input preprocessing from a LeRobot policy's config.json; None without such a file.

        Raises:
            ValueError: config.json describes an unsupported model.
        """
        return self.config.inputs if self.layout == "lerobot" and "type" in self.fields else None

    @property
    def chunk(self) -> int | None:
        """Actions per chunk in a LeRobot policy's config.json; None if it does not say."""
        return self.config.chunk if self.inputs and "chunk_size" in self.fields else None

    def load(self, config: BackboneConfig | None = None) -> Any:
        """Load the model; see the function `load`."""
        if self.layout == "ours":
            return native.load_native(self.folder, config)
        if config is not None and self.layout == "lerobot" and "type" in self.fields:
            _require_same_heads(config, self.folder, self.fields)
        try:
            model, unused = published.load_published(self.folder, config or self.config)
        except ModelMismatchError as error:
            if config is not None:
                raise
            source = native.CONFIG if self.layout == "lerobot" else "the published pi0"
            raise ValueError(f"{error}; sizes are those of {source}: pass a config") from error
        if unused:
            _log.info("%s: skipped unused tensors %s", self.folder, ", ".join(unused))
        return model


def find(where: str | os.PathLike[str]) -> ModelFolder:
    """Find a model folder, downloading it if it is remote, and detect its layout.

    Args:
        where: a folder, "hf://owner/name" or "gs://bucket/folder"; see `hub.local`.

    Raises:
        ValueError: `where` cannot be reached, its config.json is damaged, or it is an adapter or a
            folder of several models.
    """
    folder, source = hub.local(where), os.fspath(where)
    fields = _read_fields(folder)
    if "backbone" in fields:
        return ModelFolder(folder, "ours", fields, source)
    if published.orbax_folder(folder):
        return ModelFolder(folder, "openpi", fields, source)
    if fields.get("use_peft") or not _has_weights(folder):
        _refuse_adapter(folder, source)
        _refuse_parent(folder)
    return ModelFolder(folder, "lerobot", fields, source)


def load(where: str | os.PathLike[str], config: Any = None) -> Any:
    """Load a model from a folder, a Hugging Face Hub repository or a bucket.

    The layout is detected from the files: this project's config.json, LeRobot's config.json with
    the policy type, openpi's Orbax folder `params`, or the safetensors of its PyTorch conversion.

    Args:
        where: a folder, "hf://owner/name" or "gs://bucket/folder"; see `hub.local`.
        config: model sizes, dtype and param_dtype. None uses the sizes in config.json or, for
            openpi, the training config that the folder is named after (see `openpi_configs`),
            otherwise the sizes of the published pi0.

    Raises:
        ValueError: `where` cannot be reached or has none of these layouts, files are damaged, or
            the weights do not match `config` or config.json.
    """
    return find(where).load(config)


def load_config(where: str | os.PathLike[str]) -> Any:
    """Return the config that `load` uses if none is passed; no weights are read.

    Raises:
        ValueError: `where` cannot be reached or does not specify the sizes of a supported model.
    """
    return find(where).config


def _read_fields(folder: Path) -> dict[str, Any]:
    """Read config.json, and the preprocessor of a LeRobot policy; empty if there is none."""
    path, preprocessor = folder / native.CONFIG, folder / lerobot_config.PREPROCESSOR
    with as_value_error(path):
        fields = read_json(path) if path.exists() else {}
        json_values.check(fields, {})
        if "type" in fields:
            json_values.check(fields, lerobot_config.FIELDS, nulls=True)
    if "type" not in fields or not preprocessor.exists():
        return fields
    with as_value_error(preprocessor):
        return lerobot_config.preprocessed(fields, read_json(preprocessor))


def _lerobot_config(folder: Path, fields: dict[str, Any]) -> BackboneConfig:
    if pi0_files.is_conversion(fields):
        with as_value_error(folder / native.CONFIG):
            names = TensorFiles(weight_files(folder))
            return pi0_files.conversion_config(fields, pi05="time_mlp_in.weight" in names)
    if "type" not in fields and _has_weights(folder):
        raise ValueError(
            f"{folder} has weights, but no {native.CONFIG} with sizes: pass a config, or --size"
        )
    if "type" not in fields:
        raise ValueError(
            f"{folder} contains no model: expected this project's or LeRobot's {native.CONFIG}, "
            "or openpi's params/_METADATA"
        )
    with as_value_error(folder / native.CONFIG):
        return lerobot_config.parse(fields)


def _has_weights(folder: Path) -> bool:
    """Whether a folder has safetensors with a model's weights."""
    return any(path.exists() for path in weight_files(folder))


def _refuse_adapter(folder: Path, where: str) -> None:
    """Raise ValueError for a folder of Hugging Face PEFT, which LeRobot writes beside a config."""
    if not (path := folder / hugging_face.CONFIG).exists():
        return
    with as_value_error(path):
        base = str(read_json(path).get("base_model_name_or_path") or "its base")
    if hub.REPOSITORY.fullmatch(base) and not os.path.exists(base):
        base = hub.HUB + base
    raise ValueError(
        f"{where} is a PEFT adapter of {base}, not a model: load {base}, then the adapter with "
        f"load_peft(..., names=models.lerobot_names(model)); to serve it, pass {base} --adapter "
        f"NAME={where} --statistics {where}"
    )


def _refuse_parent(folder: Path) -> None:
    """Raise ValueError for a folder without a model that contains folders of models.

    openpi has one folder a step, and LeRobot checkpoints/<step>/pretrained_model.
    """
    below = {
        path.parent.parent if path.name == published.METADATA else path.parent
        for depth in _DEPTHS
        for part in _PARTS
        for path in folder.glob(f"{depth}/{part}")
        if _UNFINISHED not in str(path)
    }
    if below:
        last = max(map(str, below), key=lambda name: (len(name), name))
        raise ValueError(f"{folder} contains no model itself: pass a folder below, such as {last}")


def _require_same_heads(config: Any, folder: Path, fields: dict[str, Any]) -> None:
    """Raise ValueError if type or heads differ; tensor shapes do not reveal heads."""
    with as_value_error(folder / native.CONFIG):
        stored = lerobot_config.parse_towers(fields)
    if not isinstance(config, type(stored)):
        expected, actual = (type(c).__name__ for c in (stored, config))
        raise ValueError(f"config must be a {expected} for the policy in {folder}, got {actual}")
    for name in ("vision", "language", "action"):
        expected, actual = getattr(stored, name), getattr(config, name)
        if expected.kernel_sizes == actual.kernel_sizes and expected != actual:
            raise ValueError(f"{folder} has the {name} heads of {expected}, not of {actual}")
