"""Run other people's packages in environments of their own."""

import contextlib
import subprocess
import sys
import tempfile
import venv
from collections.abc import Iterator
from pathlib import Path

import pytest

OFFLINE = ("NewConnectionError", "ConnectTimeoutError", "ProxyError", "NameResolutionError")
"""What pip says if it cannot reach the package index."""


@contextlib.contextmanager
def environment(*packages: str) -> Iterator[Path]:
    """Yield the interpreter of a new environment with `packages`; skip the test if offline.

    The environment has this Python's version and is deleted afterwards.

    Raises:
        AssertionError: pip fails for another reason.
    """
    with tempfile.TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        python = Path(folder) / ("Scripts" if sys.platform == "win32" else "bin") / "python"
        pip = [python, "-m", "pip", "install", "-q", "--retries", "1", "--timeout", "30"]
        process = subprocess.run([*pip, *packages], capture_output=True, text=True, check=False)
        if process.returncode and any(word in process.stderr for word in OFFLINE):
            pytest.skip(f"this machine is offline, so {packages[0]} cannot be installed")
        assert process.returncode == 0, process.stderr
        yield python


def run(python: Path, *arguments: object) -> str:
    """Run a program in an environment; return what it prints.

    Raises:
        AssertionError: it fails.
    """
    command = [str(python), *map(str, arguments)]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    return process.stdout
