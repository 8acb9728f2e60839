"""The table of equations points at functions that exist and name their equations."""

import ast
import re

import pytest

from tests import ROOT

PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]
ROW = re.compile(r"^\| ([^|]+) \| [^|]*\| `([\w/]+\.py)::([\w.]+)` \|$", re.MULTILINE)
NUMBER = re.compile(r"\((\d+)\)")
ROWS = [row for page in PAGES for row in ROW.findall(page.read_text())]


def docstring(file, name):
    """That of a function, method or class; None if there is no such thing."""
    node = ast.parse((ROOT / file).read_text())
    for part in name.split("."):
        defined = [
            child
            for child in node.body
            if isinstance(child, ast.FunctionDef | ast.ClassDef) and child.name == part
        ]
        if not defined:
            return None
        (node,) = defined
    return ast.get_docstring(node)


def numbers(text):
    """Those of equations, of ranges all."""
    found = re.sub(r"\((\d+)\)-\((\d+)\)", _spelled_out, text)
    return set(NUMBER.findall(found)) | set(re.findall(r"\beqs?\. (\d+)", found))


def _spelled_out(match):
    return " ".join(f"({n})" for n in range(int(match[1]), int(match[2]) + 1))


def test_the_paper_is_in_the_table():
    found = {
        n for equation, _, _ in ROWS if equation.startswith("LoRA-SP") for n in numbers(equation)
    }
    assert {"4", "9", "10", "11", "12", "13", "14"} <= found
    methods = ("LoRA-SP", "LoRA ", "DoRA", "AdaLoRA", "Switch", "full fine-tuning")
    assert not [name for name in methods if not any(row[0].startswith(name) for row in ROWS)]


@pytest.mark.parametrize(("equation", "file", "name"), ROWS, ids=lambda text: text)
def test_a_row_points_at_its_function(equation, file, name):
    found = docstring(file, name)
    assert found is not None, f"{file} defines no {name}"
    assert numbers(equation) <= numbers(found), f"{name} does not name {equation}: {found}"
