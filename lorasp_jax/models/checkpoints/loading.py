"""Load a model from a local folder, the Hugging Face Hub or a bucket, in any known layout."""

import dataclasses
import functools
import logging
import os
from pathlib import Path
from typing import Any, Literal

from lorasp_jax.base import hub, json_values
from lorasp_jax.base.files import as_value_error, read_json
from lorasp_jax.models import backbone
from lorasp_jax.models.checkpoints import lerobot_config, native, published
from lorasp_jax.models.checkpoints.layouts import ModelMismatchError
from lorasp_jax.models.checkpoints.tensor_files import weight_files
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.inputs import InputConfig

_log = logging.getLogger(__name__)

Layout = Literal["ours", "openpi", "lerobot"]


@dataclasses.dataclass(frozen=True)
class ModelFolder:
    """A local model folder, inspected once.

    Attributes:
        folder: its path.
        layout: "ours" (this project's config.json), "openpi" (Orbax folder `params`) or, for any
            other folder, "lerobot" (safetensors and a config.json with the policy type).
        fields: contents of config.json; empty if there is no such file.
    """

    folder: Path
    layout: Layout
    fields: dict[str, Any] = dataclasses.field(repr=False)

    @functools.cached_property
    def config(self) -> BackboneConfig:
        """The config that `load` uses if none is passed; no weights are read.

        Raises:
            ValueError: the folder does not specify sizes, or its model is not supported.
        """
        if self.layout == "ours":
            return native.load_config(self.folder)
        if self.layout == "openpi":
            return backbone.find("pi0").base()
        return _lerobot_config(self.folder, self.fields)

    @property
    def inputs(self) -> InputConfig | None:
        """Input preprocessing from a LeRobot policy's config.json; None without such a file.

        Raises:
            ValueError: config.json describes an unsupported model.
        """
        return self.config.inputs if self.layout == "lerobot" and "type" in self.fields else None

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
        ValueError: `where` cannot be reached, or its config.json is damaged.
    """
    folder = hub.local(where)
    fields = _read_fields(folder)
    if "backbone" in fields:
        return ModelFolder(folder, "ours", fields)
    return ModelFolder(folder, "openpi" if published.orbax_folder(folder) else "lerobot", fields)


def load(where: str | os.PathLike[str], config: Any = None) -> Any:
    """Load a model from a folder, a Hugging Face Hub repository or a bucket.

    The layout is detected from the files: this project's config.json, LeRobot's config.json with
    the policy type, or openpi's Orbax folder `params`.

    Args:
        where: a folder, "hf://owner/name" or "gs://bucket/folder"; see `hub.local`.
        config: model sizes, dtype and param_dtype. None uses the sizes in config.json or, for
            openpi, those of the published pi0.

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
    """Read config.json; empty if there is none."""
    path = folder / native.CONFIG
    with as_value_error(path):
        fields = read_json(path) if path.exists() else {}
        json_values.check(fields, {})
    return fields


def _lerobot_config(folder: Path, fields: dict[str, Any]) -> BackboneConfig:
    if not fields and any(path.exists() for path in weight_files(folder)):
        raise ValueError(f"{folder} has weights, but no {native.CONFIG} with sizes: pass a config")
    if "type" not in fields:
        raise ValueError(
            f"{folder} contains no model: expected this project's or LeRobot's {native.CONFIG}, "
            "or openpi's params/_METADATA"
        )
    with as_value_error(folder / native.CONFIG):
        return lerobot_config.parse(fields)


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
