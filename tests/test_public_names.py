"""What users of the package reach from `lorasp_jax` itself."""

import importlib.metadata
import inspect
import subprocess
import sys

import lorasp_jax
from lorasp_jax import peft


def test_every_public_name_is_there():
    assert [name for name in lorasp_jax.__all__ if not hasattr(lorasp_jax, name)] == []


def test_every_method_is_public():
    methods = {peft.find(name).__name__ for name in peft.names()}
    assert methods <= set(lorasp_jax.__all__)


def test_what_one_makes_one_can_save_and_load():
    for name in ("split", "save_adapters", "load_adapters", "save_peft", "load_peft"):
        assert inspect.getdoc(getattr(lorasp_jax, name))


def test_the_version_is_that_of_the_installed_package():
    assert lorasp_jax.__version__ == importlib.metadata.version("lorasp_jax")


def test_a_folder_of_the_same_name_does_not_hide_the_package(tmp_path):
    """As a checkout does for whoever starts Python beside it."""
    (tmp_path / "lorasp_jax" / "data").mkdir(parents=True)
    use = "import lorasp_jax.data.keys; lorasp_jax.adapt"
    subprocess.run([sys.executable, "-c", use], cwd=tmp_path, check=True)
