"""The site builds without a warning and has a place for every public name."""

import re
import subprocess
import sys
import zlib

import pytest

import envs
import lorasp_jax
from lorasp_jax import evaluation, models, peft, policies
from tests import ROOT


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return folder


@pytest.mark.parametrize("package", [lorasp_jax, peft, models, policies, evaluation, envs])
def test_every_public_name_has_its_place(site, package):
    _, _, _, _, listing = (site / "objects.inv").read_bytes().split(b"\n", 4)
    documented = {line.split(" ", 1)[0] for line in zlib.decompress(listing).decode().splitlines()}
    wanted = {f"{package.__name__}.{name}" for name in package.__all__}
    assert wanted <= documented, wanted - documented


def test_no_link_leaves_the_site(site):
    for page in site.rglob("*.html"):
        text = page.read_text()
        for target in re.findall(r'(?:href|src)="(?!https?:|#|data:|mailto:)([^"#?]+)', text):
            base = site if target.startswith("/") else page.parent
            assert (base / target.lstrip("/")).exists(), f"{page} links to {target}"
