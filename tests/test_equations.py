"""Test that the equation table points at functions whose docstrings name the equations."""

import ast
import re

import pytest

from tests import ROOT

PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]
ROW = re.compile(r"^\| ([^|]+) \| [^|]*\| `([\w/]+\.py)::([\w.]+)` \|$", re.MULTILINE)
NUMBER = re.compile(r"\((\d+)\)")
ROWS = [row for page in PAGES for row in ROW.findall(page.read_text())]


def docstring(file, name):
    """Return the docstring of a function, method or class, or None if it does not exist."""
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
    """Return the equation numbers in a text, with ranges expanded."""
    expanded = re.sub(r"\((\d+)\)-\((\d+)\)", _expand, text)
    return set(NUMBER.findall(expanded)) | set(re.findall(r"\beqs?\. (\d+)", expanded))


def _expand(match):
    return " ".join(f"({n})" for n in range(int(match[1]), int(match[2]) + 1))


def test_table_covers_the_paper():
    listed = {
        n for equation, _, _ in ROWS if equation.startswith("LoRA-SP") for n in numbers(equation)
    }
    assert {"9", "10", "11", "12", "13", "14"} <= listed
    methods = ("LoRA-SP", "LoRA ", "DoRA", "AdaLoRA", "Switch", "full fine-tuning")
    assert not [name for name in methods if not any(row[0].startswith(name) for row in ROWS)]


@pytest.mark.parametrize(("equation", "file", "name"), ROWS, ids=lambda text: text)
def test_row_points_at_a_function_that_names_the_equation(equation, file, name):
    text = docstring(file, name)
    assert text is not None, f"{file} does not define {name}"
    assert numbers(equation) <= numbers(text), f"{name} does not name {equation}: {text}"
