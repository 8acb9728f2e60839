"""A dataset with its options in a small TOML file, which stands for the dataset everywhere.

    path = "recordings/fold"    # relative to this file; or hf://owner/name
    angles = "degrees"
    every = 3

    [cameras]
    top = "observation.images.cam_high"

Options are the fields of `Keys` but `image_size`, which depends on the model. Formats other than
LeRobot take cameras alone: name -> the dataset's own name.
"""

import dataclasses
import json
import os
import tomllib
from pathlib import Path
from typing import Any

from lorasp_jax.base import hub
from lorasp_jax.base.files import as_value_error, read_text
from lorasp_jax.base.writing import write_text
from lorasp_jax.data.keys import Keys
from lorasp_jax.peft import fields

_OPTIONS = [field.name for field in dataclasses.fields(Keys) if field.name != "image_size"]
_File = dataclasses.make_dataclass("_File", ["path", *_OPTIONS])


def is_file(where: str | os.PathLike[str]) -> bool:
    """Whether this is a dataset file, by its name."""
    return Path(where).suffix == ".toml"


def read(where: str | os.PathLike[str], image_size: int) -> tuple[str, Keys]:
    """Return the location of the dataset and its options.

    Raises:
        ValueError: the file is missing or no TOML, or an option is unknown or has a wrong value.
    """
    file = Path(where)
    with as_value_error(file):
        content: dict[str, Any] = tomllib.loads(read_text(file))
    fields.check_names(_File, str(file), (), content)
    path = content.pop("path", None)
    if not isinstance(path, str) or not path:
        raise ValueError(f'{file} must say where the dataset is: path = "...", got {path!r}')
    options: dict[str, Any] = {
        key: _tuple(x) if isinstance(x, list) else x for key, x in content.items()
    }
    try:
        keys = Keys(**options, image_size=image_size)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error
    return path if hub.is_remote(path) else str(file.parent / path), keys


def write(file: Path, where: str, keys: Keys) -> None:
    """Write a dataset file with the options that are not the defaults.

    A local path, in `where`, is written relative to the file.
    """
    path = where
    if not hub.is_remote(where):  # ".." leads out of where a link to a folder leads
        above, own = (os.path.realpath(x.parent) for x in (Path(where), file))
        path = os.path.relpath(os.path.join(above, Path(where).name), own)
    # Strings, numbers and lists look the same in JSON and in TOML.
    lines = [f"path = {_text(path)}"]
    for name in _OPTIONS:
        value = getattr(keys, name)
        if value != getattr(Keys(), name) and name != "cameras":
            lines.append(f"{name} = {_text(value)}")
    if keys.cameras:
        pairs = (f"{_text(name)} = {_text(feature)}" for name, feature in keys.cameras.items())
        lines += ["", "[cameras]", *pairs]
    write_text(file, "\n".join(lines) + "\n")


def _tuple(values: list[Any]) -> tuple[Any, ...]:
    """Return a list of names, in which dimensions may be numbers."""
    return tuple(str(x) if type(x) is int else x for x in values)


def _text(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)
