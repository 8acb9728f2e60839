"""Run the Python files that define experiments, found also from outside the project's folder."""

import importlib.util
import os
from pathlib import Path
from typing import Any

from lorasp_jax.base import shipped


def call(path: Path, function: str, scale: str) -> Any:
    """Run an experiment file and return the result of `function(scale)`.

    Bundled experiments, such as configs/multitask.py, are found from any working directory.

    Raises:
        ValueError: the file is missing, lacks the function, or its code fails.
    """
    bundled = shipped.ROOT / path
    if shipped.is_under(path, shipped.EXPERIMENTS) and not os.path.exists(path):
        path = bundled if os.path.isfile(bundled) else path
    if not os.path.isfile(path):  # Path.is_file raises if a name is too long
        folder = path.parent if os.path.isdir(path.parent) else shipped.ROOT / shipped.EXPERIMENTS
        available = ", ".join(str(file) for file in sorted(folder.glob("*.py")))
        hint = f": available configs are {available}" if available else ""
        raise ValueError(f"config {path} does not exist{hint}")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
        if not hasattr(module, function):
            raise ValueError(f"function {function}(scale) is missing")
        return getattr(module, function)(scale)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # the file may raise anything
        reason = str(error).partition("\n")[0]
        raise ValueError(f"cannot load {path} ({type(error).__name__}: {reason})") from error
