"""Whoever builds on the packages gets their types: nothing public is of an unknown one."""

import json
import subprocess
import sys

import pytest

from tests import ROOT

UNTYPED = ("envs.interop.brax.", "envs.datasets.rlds_schema.")
"""What is of classes of Brax and of tensorflow-datasets, which have no types."""
SHARE = {"lorasp_jax": 0.94, "envs": 0.98}
"""Least share of public names whose type is certain: some attributes' follows from what they are
set to, which checkers may read in different ways."""


@pytest.mark.slow
@pytest.mark.parametrize("package", SHARE)
def test_public_names_have_types(package):
    command = [sys.executable, "-m", "pyright", "--verifytypes", package, "--ignoreexternal"]
    found = subprocess.run(
        [*command, "--outputjson"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    report = json.loads(found.stdout)["typeCompleteness"]
    unknown = [
        symbol["name"]
        for symbol in report["symbols"]
        if symbol["isExported"] and not (symbol["isTypeKnown"] or symbol["isTypeAmbiguous"])
    ]
    assert [name for name in unknown if not name.startswith(UNTYPED)] == []
    assert report["completenessScore"] >= SHARE[package]
