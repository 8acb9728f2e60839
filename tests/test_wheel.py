"""The wheel: what is in it, and that it does the main job where there is no checkout."""

import json
import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

import lorasp_jax
from tests import ROOT

LARGEST = 8 * 2**20  # bytes


def pip(*arguments):
    options = ["--no-deps", "--no-index", "--disable-pip-version-check", "--quiet"]
    command = [sys.executable, "-m", "pip", *arguments, *options]
    subprocess.run(command, check=True)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    pip("wheel", str(ROOT), "--no-build-isolation", "--wheel-dir", str(folder))
    return next(folder.glob("*.whl"))


def test_what_is_inside(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    tops = {name.partition("/")[0] for name in names}
    assert tops == {"lorasp_jax", "envs", f"lorasp_jax-{lorasp_jax.__version__}.dist-info"}
    assert {"lorasp_jax/py.typed", "envs/py.typed"} <= names
    for folder in ("configs", "assets/pi0_nano", "assets/smolvla_nano"):
        files = {path.name for path in (ROOT / folder).iterdir() if path.is_file()}
        assert {f"lorasp_jax/{folder}/{name}" for name in files} <= names
    for package in ("lorasp_jax", "envs"):
        modules = {str(path.relative_to(ROOT)) for path in (ROOT / package).rglob("*.py")}
        assert modules <= names
    assert not [name for name in names if "_small" in name or "__pycache__" in name]
    assert wheel.stat().st_size < LARGEST


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """What runs a command of a fresh environment, in which our package alone comes from a wheel."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, symlinks=True)
    python = folder / "bin" / "python"
    pip("--python", str(python), "install", str(wheel))
    own = subprocess.run(
        [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.strip()
    # A folder added so is no site: an editable install there adds no checkout.
    Path(own, "others.pth").write_text(sysconfig.get_path("purelib") + "\n")
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def run(command, *arguments, cwd):
        return subprocess.run(
            [folder / "bin" / command, *arguments],
            cwd=cwd,
            env=kept | {"XLA_FLAGS": ""},
            capture_output=True,
            text=True,
            check=False,
        )

    return run


@pytest.mark.slow
def test_it_lies_in_the_environment(installed, tmp_path):
    where = "import envs, lorasp_jax; print(envs.__file__, lorasp_jax.__file__)"
    found = installed("python", "-c", where, cwd=tmp_path)
    assert found.stdout.count("site-packages") == 2, found.stderr
    assert str(ROOT) not in found.stdout
    version = installed("lorasp-jax", "--version", cwd=tmp_path).stdout
    assert version == f"lorasp-jax {lorasp_jax.__version__}\n"


@pytest.mark.slow
def test_a_base_that_is_not_inside_is_named(installed, tmp_path):
    asked = ["train", "--config", "configs/multitask.py", "--scale", "accelerator", "--dry-run"]
    found = installed("lorasp-jax", *asked, cwd=tmp_path)
    assert found.returncode == 2
    assert "are pi0_nano, smolvla_nano; take pi0_small from a checkout" in found.stderr
    assert found.stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_smoke_scale_in_an_empty_folder(installed, tmp_path):
    asked = ["--scale", "smoke", "--tasks", "press", "--name", "smoke"]
    found = installed(
        "lorasp-jax", "train", "--config", "configs/multitask.py", *asked, cwd=tmp_path
    )
    assert found.returncode == 0, found.stderr
    folder = tmp_path / "runs" / "smoke"
    press = json.loads((folder / "results.json").read_text())["tasks"]["press"]
    assert press["after"]["success"] > press["before"]["success"]
    written = (folder / "report.html").read_bytes()
    found = installed("lorasp-jax", "report", "runs/smoke", cwd=tmp_path)
    assert (found.returncode, found.stdout) == (0, "report: runs/smoke/report.html\n"), found.stderr
    assert (folder / "report.html").read_bytes() == written
