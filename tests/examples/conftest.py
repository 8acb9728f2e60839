"""Examples as modules: no packages, so they are loaded by their files."""

import importlib.util
import sys

import pytest

from tests import ROOT
from tests.extras.piper.conftest import bench, patient, world  # noqa: F401


@pytest.fixture(scope="session")
def load():
    """Return a function that loads a file of `examples/`."""
    names = []

    def load(path):
        names.append(name := path.replace("/", "_").removesuffix(".py"))
        spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / path)
        sys.modules[name] = module = importlib.util.module_from_spec(spec)  # dataclasses look here
        spec.loader.exec_module(module)
        return module

    yield load
    for name in names:
        del sys.modules[name]
