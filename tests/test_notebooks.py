"""Test that the notebooks run from the first cell to the last in an empty folder."""

import re

import nbclient
import nbformat
import pytest

from tests import ROOT

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
MAX_SECONDS = 15 * 60
"""Time limit of a notebook [s]; the test allows twice as much on a busy machine."""


def cells(path, kind):
    return [cell for cell in nbformat.read(path, 4).cells if cell.cell_type == kind]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_has_no_outputs_and_installs_first(path):
    first, *rest = cells(path, "code")
    assert "%pip install" in first.source
    assert not any(cell.outputs or cell.execution_count for cell in (first, *rest))
    lines = "\n".join(cell.source for cell in rest).splitlines()
    exec("\n".join(line for line in lines if re.match(r"(from|import) (envs|lorasp_jax)\b", line)))


@pytest.mark.slow
@pytest.mark.timeout(4 * MAX_SECONDS)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, tmp_path):
    notebook = nbformat.read(path, 4)
    resources = {"metadata": {"path": str(tmp_path)}}
    client = nbclient.NotebookClient(
        notebook, timeout=2 * MAX_SECONDS, kernel_name="python3", resources=resources
    )
    client.execute()
