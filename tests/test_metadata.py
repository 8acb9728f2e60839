"""What says who made the software and which version it is."""

import re

import yaml

import lorasp_jax
from tests import ROOT


def test_citation_names_the_software_and_the_paper():
    """The fields that the Citation File Format 1.2.0 requires."""
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(cited)
    assert "version" not in cited, "that stands in lorasp_jax/__init__.py"
    (paper,) = cited["references"]
    assert {"type", "title", "authors"} <= set(paper)
    assert paper["url"].endswith("2603.07404")


def test_the_newest_version_in_the_changelog_is_the_package_s():
    newest, *_ = re.findall(r"^## \[(.*?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest == lorasp_jax.__version__
