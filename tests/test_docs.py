"""The documentation's examples run as they stand, and its tables say what the code says."""

import ast
import dataclasses
import re

import pytest

from lorasp_jax import peft
from tests import ROOT

PAGES = sorted([*ROOT.glob("docs/*.md"), *ROOT.glob("docs/methods/*.md")])
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
OPTION = re.compile(r"^\| `(\w+)` \| `([^`]+)` \| \S", re.MULTILINE)
LINK = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)")


def page_of(name):
    return ROOT / "docs" / "methods" / f"{name}.md"


def examples(page):
    """All of a page's examples as one program, whose line numbers are those of the page."""
    text, lines = page.read_text(), []
    for match in BLOCK.finditer(text):
        start = text.count("\n", 0, match.start(1))
        lines += [""] * (start - len(lines)) + match[1].splitlines()
    return "\n".join(lines)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_examples_run(page, tmp_path, monkeypatch):
    code = examples(page)
    assert code.strip(), f"{page} has no example"
    monkeypatch.chdir(tmp_path)
    exec(compile(code, str(page), "exec"), {"__name__": "documentation"})


def test_pages_are_those_of_the_methods():
    pages = {page.stem for page in PAGES if page.parent.name == "methods"}
    assert pages == set(peft.names())


@pytest.mark.parametrize("name", peft.names())
def test_option_table_is_that_of_the_method(name):
    options = [
        (field, ast.literal_eval(d)) for field, d in OPTION.findall(page_of(name).read_text())
    ]
    fields = dataclasses.fields(peft.find(name))
    assert options == [(field.name, field.default) for field in fields]


@pytest.mark.parametrize("name", peft.names())
def test_page_shows_the_method_at_work(name):
    code = examples(page_of(name))
    assert peft.find(name).__name__ in code


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    for target in LINK.findall(BLOCK.sub("", page.read_text())):
        assert (page.parent / target).exists(), f"{page} links to {target}"
