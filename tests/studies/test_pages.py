"""Each study's page: its tables and figures are made from its results file, byte for byte."""

import re
import shutil

import pytest

from lorasp_jax.extras.study import results
from lorasp_jax.extras.study.__main__ import main
from tests import ROOT

STUDIES = ROOT / "studies"


def rebuild(name, tmp_path):
    """Check that the study's command would change no file in its folder."""
    folder = tmp_path / name
    shutil.copytree(STUDIES / name, folder)
    shutil.rmtree(folder / "figures", ignore_errors=True)
    text = (folder / "README.md").read_text()
    (folder / "README.md").write_text(re.sub(r"(begin: .*-->\n)(?s:.*?)(<!-- end)", r"\1\2", text))
    options = ["--results", str(folder / "results.json"), "--no-run", "--out", str(tmp_path)]
    assert main(["--config", str(STUDIES / name / "study.py"), *options]) == 0
    for path in (p for p in (STUDIES / name).rglob("*") if p.suffix in (".md", ".json", ".svg")):
        made, there = (folder / path.relative_to(STUDIES / name)).read_bytes(), path.read_bytes()
        versions = [re.findall(rb"Matplotlib v[\d.]+", content) for content in (made, there)]
        if versions[0] == versions[1]:  # other versions of Matplotlib draw other bytes
            assert made == there, path


@pytest.mark.slow
def test_paper(tmp_path):
    rebuild("paper", tmp_path)


@pytest.mark.slow
def test_metaworld(tmp_path):
    rebuild("metaworld", tmp_path)


def test_few(tmp_path):
    rebuild("few", tmp_path)


def test_flow_steps(tmp_path):
    rebuild("flow_steps", tmp_path)


def test_reinforce(tmp_path):
    rebuild("reinforce", tmp_path)


def test_where_it_pays(tmp_path):
    rebuild("where_it_pays", tmp_path)


def test_latency(tmp_path):
    rebuild("latency", tmp_path)


def test_deployment(tmp_path):
    rebuild("deployment", tmp_path)


def test_all_files_of_results_can_be_read():
    for path in STUDIES.glob("*/results.json"):
        results.load(path, path.parent.name)
