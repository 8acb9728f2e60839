"""The notebooks run from the first cell to the last, in an empty folder."""

import nbclient
import nbformat
import pytest

from tests import ROOT

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LONGEST = 15 * 60
"""Seconds that a notebook may take."""


def cells(path, kind):
    return [cell for cell in nbformat.read(path, 4).cells if cell.cell_type == kind]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_is_committed_without_outputs_and_installs_first(path):
    first, *rest = cells(path, "code")
    assert "%pip install" in first.source
    assert not any(cell.outputs or cell.execution_count for cell in (first, *rest))


@pytest.mark.slow
@pytest.mark.timeout(4 * LONGEST)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_runs(path, tmp_path):
    notebook = nbformat.read(path, 4)
    resources = {"metadata": {"path": str(tmp_path)}}
    client = nbclient.NotebookClient(
        notebook, timeout=2 * LONGEST, kernel_name="python3", resources=resources
    )
    client.execute()
