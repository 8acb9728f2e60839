"""Test that the API pages have every public name, and that the site builds without warnings."""

import itertools
import re
import subprocess
import sys
import zlib

import pytest

from docs import build
from tests import ROOT
from tests.test_public_names import PUBLIC, SHOWN

DOCUMENTED_ELSEWHERE = {"envs", "envs.rlds", "lorasp_jax.models.published"}
"""Modules whose names are documented under another module."""
MODULES = [*PUBLIC.items(), *((name, SHOWN[name]) for name in SHOWN.keys() - DOCUMENTED_ELSEWHERE)]


@pytest.mark.parametrize(("module", "names"), sorted(MODULES))
def test_every_public_name_is_on_a_page(module, names):
    pages = "\n".join(itertools.starmap(build.api_page, build.API.items()))
    expected = {f"{module}.{name}" for name in names.split()}
    assert expected <= set(re.findall(r"^::: (\S+)$", pages, re.MULTILINE))


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    return folder


@pytest.mark.slow
def test_every_public_name_is_documented(site):
    _, _, _, _, listing = (site / "objects.inv").read_bytes().split(b"\n", 4)
    documented = {line.split(" ", 1)[0] for line in zlib.decompress(listing).decode().splitlines()}
    expected = {f"{module}.{name}" for module, names in MODULES for name in names.split()}
    assert expected <= documented, expected - documented


@pytest.mark.slow
def test_internal_links_resolve(site):
    for page in site.rglob("*.html"):
        text = page.read_text()
        for target in re.findall(r'(?:href|src)="(?!https?:|#|data:|mailto:)([^"#?]+)', text):
            base = site if target.startswith("/") else page.parent
            assert (base / target.lstrip("/")).exists(), f"{page} links to {target}"
