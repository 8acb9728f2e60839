"""Models from wherever they are published, in whichever layout."""

import dataclasses
import functools
import json
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from envs.datasets.files import read_text
from lorasp_jax.models import backbone
from lorasp_jax.models.checkpoints import lerobot_config, native, published
from lorasp_jax.models.checkpoints.layouts import OtherModelError
from lorasp_jax.models.checkpoints.tensor_files import weight_files
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.inputs import InputConfig
from lorasp_jax.storage import hub

_log = logging.getLogger(__name__)

Layout = Literal["ours", "openpi", "lerobot"]


@dataclasses.dataclass(frozen=True)
class Found:
    """A model's folder on this machine, inspected once.

    Attributes:
        folder: its path.
        layout: whose files they are: this project's config.json, openpi's Orbax folder `params`, or
            LeRobot's safetensors with a config.json of the policy's type.
        fields: the content of config.json, empty where there is none.
    """

    folder: Path
    layout: Layout
    fields: dict[str, Any] = dataclasses.field(repr=False)

    @functools.cached_property
    def config(self) -> BackboneConfig:
        """The config that `load` gives the model without one, before any weights are read.

        Raises:
            ValueError: the files say no sizes, or those of no model here.
        """
        if self.layout == "ours":
            return native.load_config(self.folder)
        if self.layout == "openpi":
            return backbone.find("pi0").base()
        return _lerobot_config(self.folder, self.fields)

    @property
    def inputs(self) -> InputConfig | None:
        """How a policy of LeRobot's is fed, by its config.json; None where that is not said.

        Raises:
            ValueError: the file describes no model here.
        """
        return self.config.inputs if self.layout == "lerobot" and "type" in self.fields else None

    def load(self, config: BackboneConfig | None = None) -> Any:
        """The model; arguments and errors as for `load`."""
        if self.layout == "ours":
            return native.load_native(self.folder, config)
        if config is not None and self.layout == "lerobot" and "type" in self.fields:
            _require_same_heads(config, self.folder, self.fields)
        try:
            model, unused = published.load_published(self.folder, config or self.config)
        except OtherModelError as error:
            if config is not None:
                raise
            raise ValueError(f"{error} {self._whence()}") from error
        if unused:
            _log.info("%s: nothing reads %s, left out", self.folder, ", ".join(unused))
        return model

    def _whence(self) -> str:
        """Where the sizes come from, for whoever gave none."""
        if self.layout == "openpi":
            return (
                "Nothing in a folder of openpi's says its sizes, so the published pi0's were "
                "taken: pass a config."
            )
        policy = self.fields["type"]
        return f"So says {self.folder / native.CONFIG}, of a policy of type {policy!r}."


def find(where: str | os.PathLike[str]) -> Found:
    """What is in a folder, a repository on Hugging Face's hub or a bucket.

    Args:
        where: a folder; "hf://owner/name"; "gs://bucket/folder", see `hub.local`.

    Raises:
        ValueError: the place cannot be reached, or its config.json is damaged.
    """
    folder = hub.local(where)
    fields = _fields(folder)
    if "backbone" in fields:
        return Found(folder, "ours", fields)
    return Found(folder, "openpi" if published.orbax_folder(folder) else "lerobot", fields)


def load(where: str | os.PathLike[str], config: Any = None) -> Any:
    """A model from a folder, a repository on Hugging Face's hub or a bucket.

    Layouts are told apart by their files: this project's config.json, LeRobot's config.json with
    the policy's type, openpi's Orbax folder `params`.

    Args:
        where: a folder; "hf://owner/name"; "gs://bucket/folder", see `hub.local`.
        config: sizes of the model, and the types to compute and to store in. None takes the sizes
            from LeRobot's or this project's config.json, and those of pi0 as published for openpi.

    Raises:
        ValueError: the place cannot be reached, none of these layouts is there, files are damaged,
            or the model is another one than `config` or config.json say.
    """
    return find(where).load(config)


def load_config(where: str | os.PathLike[str]) -> Any:
    """The config that `load` gives a model without one, before any weights are read.

    Raises:
        ValueError: as `load`.
    """
    return find(where).config


def _fields(folder: Path) -> dict[str, Any]:
    """The content of config.json, empty where there is none."""
    path = folder / native.CONFIG
    try:
        found = json.loads(read_text(path)) if path.exists() else {}
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged.") from error
    if not isinstance(found, dict):
        raise ValueError(f"{path} is damaged.")
    return found


def _lerobot_config(folder: Path, fields: dict[str, Any]) -> BackboneConfig:
    config = folder / native.CONFIG
    if not fields and any(path.exists() for path in weight_files(folder)):
        raise ValueError(
            f"{folder} holds weights, but no {config.name} that says their sizes: pass a config."
        )
    if not fields:
        raise ValueError(
            f"{folder} holds no model: there is no {config.name} of this project or LeRobot, "
            "and no params/_METADATA of openpi."
        )
    if "type" not in fields:
        raise ValueError(
            f"{config} is neither this project's, which names a backbone, nor LeRobot's, "
            "which names the policy's type."
        )
    return _of_lerobot(lerobot_config.config_of, folder, fields)


def _of_lerobot(read: Callable[[dict[str, Any]], Any], folder: Path, fields: dict[str, Any]) -> Any:
    try:
        return read(fields)
    except ValueError as error:
        raise ValueError(
            f"{folder / native.CONFIG} fits no backbone: {str(error).rstrip('.')}."
        ) from error


def _require_same_heads(config: Any, folder: Path, fields: dict[str, Any]) -> None:
    """Refuse what tensors of LeRobot's do not tell: other heads of the same matrices."""
    stored = _of_lerobot(lerobot_config.towers_of, folder, fields)
    if not isinstance(config, type(stored)):
        found, wanted = (type(each).__name__ for each in (stored, config))
        raise ValueError(f"{folder / native.CONFIG} is of a {found}, not of a {wanted}.")
    for name in ("vision", "language", "action"):
        one, other = getattr(stored, name), getattr(config, name)
        if one.matrices == other.matrices and one != other:
            raise ValueError(
                f"{folder} does not fit the model: heads of {name} are {one}, not {other}."
            )
