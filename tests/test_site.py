"""Test that the site builds without warnings and documents every public name."""

import re
import subprocess
import sys
import zlib

import pytest

from tests import ROOT
from tests.test_public_names import PUBLIC, SHOWN

DOCUMENTED_ELSEWHERE = {"envs", "envs.rlds", "lorasp_jax.models.published"}
"""Modules whose names are documented under another module."""
MODULES = [*PUBLIC.items(), *((name, SHOWN[name]) for name in SHOWN.keys() - DOCUMENTED_ELSEWHERE)]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    return folder


@pytest.mark.parametrize(("module", "names"), sorted(MODULES))
def test_every_public_name_is_documented(site, module, names):
    _, _, _, _, listing = (site / "objects.inv").read_bytes().split(b"\n", 4)
    documented = {line.split(" ", 1)[0] for line in zlib.decompress(listing).decode().splitlines()}
    expected = {f"{module}.{name}" for name in names.split()}
    assert expected <= documented, expected - documented


def test_internal_links_resolve(site):
    for page in site.rglob("*.html"):
        text = page.read_text()
        for target in re.findall(r'(?:href|src)="(?!https?:|#|data:|mailto:)([^"#?]+)', text):
            base = site if target.startswith("/") else page.parent
            assert (base / target.lstrip("/")).exists(), f"{page} links to {target}"
