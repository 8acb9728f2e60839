"""Test that every public name has a known type, for users who type-check their own code."""

import json
import subprocess
import sys

import pytest

from tests import ROOT

UNTYPED = (
    *("envs.interop.brax.", "envs.datasets.rlds_schema."),
    *("lorasp_jax.extras.judge.vla_eval.", "lorasp_jax.extras.serving.vla_eval."),
)
"""Names that depend on Brax, tensorflow-datasets and vla-eval, which are untyped or not here."""
MIN_COMPLETENESS = {"lorasp_jax": 0.94, "envs": 0.98}
"""Minimum completeness score. It is below 1 because type checkers may infer the types of some
attributes differently."""


@pytest.mark.slow
@pytest.mark.parametrize("package", MIN_COMPLETENESS)
def test_public_names_have_types(package):
    command = [sys.executable, "-m", "pyright", "--verifytypes", package, "--ignoreexternal"]
    process = subprocess.run(
        [*command, "--outputjson"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    report = json.loads(process.stdout)["typeCompleteness"]
    unknown = [
        symbol["name"]
        for symbol in report["symbols"]
        if symbol["isExported"] and not (symbol["isTypeKnown"] or symbol["isTypeAmbiguous"])
    ]
    assert [name for name in unknown if not name.startswith(UNTYPED)] == []
    assert report["completenessScore"] >= MIN_COMPLETENESS[package]
