"""Test the contents of the wheel and that it works without a checkout."""

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

MAX_BYTES = 8 * 2**20


def pip(*arguments):
    options = ["--no-deps", "--no-index", "--disable-pip-version-check", "--quiet"]
    command = [sys.executable, "-m", "pip", *arguments, *options]
    subprocess.run(command, check=True)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    pip("wheel", str(ROOT), "--no-build-isolation", "--wheel-dir", str(folder))
    return next(folder.glob("*.whl"))


def test_contents(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    top_level = {name.partition("/")[0] for name in names}
    assert top_level == {"lorasp_jax", "envs", f"lorasp_jax-{lorasp_jax.__version__}.dist-info"}
    assert {"lorasp_jax/py.typed", "envs/py.typed"} <= names
    assert "lorasp_jax/extras/serving/status.html" in names
    for folder in ("configs", "assets/pi0_nano", "assets/smolvla_nano"):
        files = {path.name for path in (ROOT / folder).iterdir() if path.is_file()}
        assert {f"lorasp_jax/{folder}/{name}" for name in files} <= names
    for package in ("lorasp_jax", "envs"):
        modules = {str(path.relative_to(ROOT)) for path in (ROOT / package).rglob("*.py")}
        assert modules <= names
    assert not [name for name in names if "_small" in name or "__pycache__" in name]
    assert wheel.stat().st_size < MAX_BYTES


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """Run commands in a fresh environment with this package from the wheel, the rest inherited."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, symlinks=True)
    python = folder / "bin" / "python"
    pip("--python", str(python), "install", str(wheel))
    site_packages = subprocess.run(
        [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.strip()
    # .pth files in a folder added like this are ignored, so an editable install adds no checkout.
    Path(site_packages, "others.pth").write_text(sysconfig.get_path("purelib") + "\n")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def run(command, *arguments, cwd):
        return subprocess.run(
            [folder / "bin" / command, *arguments],
            cwd=cwd,
            env=environment | {"XLA_FLAGS": ""},
            capture_output=True,
            text=True,
            check=False,
        )

    return run


@pytest.mark.slow
def test_package_is_imported_from_the_environment(installed, tmp_path):
    code = "import envs, lorasp_jax; print(envs.__file__, lorasp_jax.__file__)"
    process = installed("python", "-c", code, cwd=tmp_path)
    assert process.stdout.count("site-packages") == 2, process.stderr
    assert str(ROOT) not in process.stdout
    version = installed("lorasp-jax", "--version", cwd=tmp_path).stdout
    assert version == f"lorasp-jax {lorasp_jax.__version__}\n"


@pytest.mark.slow
def test_missing_base_is_named(installed, tmp_path):
    arguments = ["train", "--config", "configs/multitask.py", "--scale", "accelerator", "--dry-run"]
    process = installed("lorasp-jax", *arguments, cwd=tmp_path)
    assert process.returncode == 2
    assert "pi0_small does not exist" in process.stderr
    assert "pi0_nano, smolvla_nano" in process.stderr
    assert process.stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_smoke_scale_in_an_empty_folder(installed, tmp_path):
    arguments = ["--scale", "smoke", "--tasks", "press", "--name", "smoke"]
    process = installed(
        "lorasp-jax", "train", "--config", "configs/multitask.py", *arguments, cwd=tmp_path
    )
    assert process.returncode == 0, process.stderr
    folder = tmp_path / "runs" / "smoke"
    press = json.loads((folder / "results.json").read_text())["tasks"]["press"]
    assert press["after"]["success"] > press["before"]["success"]
    report = (folder / "report.html").read_bytes()
    process = installed("lorasp-jax", "report", "runs/smoke", cwd=tmp_path)
    assert (process.returncode, process.stdout) == (0, "report: runs/smoke/report.html\n"), (
        process.stderr
    )
    assert (folder / "report.html").read_bytes() == report
