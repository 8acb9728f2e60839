"""Test the citation file and the version."""

import re

import yaml

import lorasp_jax
from tests import ROOT


def test_citation_names_the_software_and_the_paper():
    """Check the fields that Citation File Format 1.2.0 requires."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert "version" not in citation, "the version is defined in lorasp_jax/__init__.py"
    (paper,) = citation["references"]
    assert {"type", "title", "authors"} <= set(paper)
    assert paper["url"].endswith("2603.07404")


def test_newest_changelog_version_is_the_package_version():
    newest, *_ = re.findall(r"^## \[(.*?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest == lorasp_jax.__version__
