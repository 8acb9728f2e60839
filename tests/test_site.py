"""The site builds without a warning and has a place for every public name."""

import re
import subprocess
import sys
import zlib

import pytest

from tests import ROOT
from tests.test_public_names import PUBLIC, SHOWN

ELSEWHERE = {"envs", "envs.rlds", "lorasp_jax.models.published"}
"""Modules by the name of which nothing is listed: those of others, under the others' names."""
WANTED = [*PUBLIC.items(), *((name, SHOWN[name]) for name in SHOWN.keys() - ELSEWHERE)]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return folder


@pytest.mark.parametrize(("module", "names"), sorted(WANTED))
def test_every_public_name_has_its_place(site, module, names):
    _, _, _, _, listing = (site / "objects.inv").read_bytes().split(b"\n", 4)
    documented = {line.split(" ", 1)[0] for line in zlib.decompress(listing).decode().splitlines()}
    wanted = {f"{module}.{name}" for name in names.split()}
    assert wanted <= documented, wanted - documented


def test_no_link_leaves_the_site(site):
    for page in site.rglob("*.html"):
        text = page.read_text()
        for target in re.findall(r'(?:href|src)="(?!https?:|#|data:|mailto:)([^"#?]+)', text):
            base = site if target.startswith("/") else page.parent
            assert (base / target.lstrip("/")).exists(), f"{page} links to {target}"
