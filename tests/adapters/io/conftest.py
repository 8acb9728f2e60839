"""Fixtures for tests of adapter files."""

import shutil
from pathlib import Path

import pytest

from tests.adapters.io.peft_folder import FOLDER


@pytest.fixture
def copy(tmp_path):
    """A writable copy of the PEFT folder."""
    return Path(shutil.copytree(FOLDER, tmp_path / "copy"))
