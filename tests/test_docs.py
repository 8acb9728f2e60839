"""The documentation's examples run as they stand, and its tables say what the code says."""

import ast
import dataclasses
import itertools
import re

import pytest

from lorasp_jax import peft
from tests import ROOT, test_imports

PAGES = sorted([*ROOT.glob("docs/*.md"), *ROOT.glob("docs/methods/*.md")])
WITHOUT_EXAMPLES = {"runs", "benchmarks", "architecture"}
"""Pages that look things up."""
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
OPTION = re.compile(r"^\| `(\w+)` \| `([^`]+)` \| \S", re.MULTILINE)
LINK = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)|src(?:set)?=\"([^\":]+)\"")
FILE = re.compile(r"`((?:lorasp_jax|envs|benchmarks|configs|examples|tests)/[\w/]+\.py)[`:]")
FUNCTION = re.compile(r"`([\w/]+\.py)::(\w+)`")
NODE = re.compile(r"^    (\w+)\[", re.MULTILINE)
ARROWS = re.compile(r"^    (\w+(?: --> \w+)+)$", re.MULTILINE)


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
    assert bool(code.strip()) != (page.stem in WITHOUT_EXAMPLES), f"{page} has no example"
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
    for link, source in LINK.findall(BLOCK.sub("", page.read_text())):
        target = link or source
        assert (page.parent / target).exists(), f"{page} links to {target}"


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda page: page.stem)
def test_files_are_where_a_page_says(page):
    assert [file for file in FILE.findall(page.read_text()) if not (ROOT / file).is_file()] == []


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda page: page.stem)
def test_functions_are_where_a_page_says(page):
    for file, name in FUNCTION.findall(page.read_text()):
        tree = ast.parse((ROOT / file).read_text())
        kinds = (ast.FunctionDef, ast.ClassDef)
        defined = {node.name for node in tree.body if isinstance(node, kinds)}
        assert name in defined, f"{page} names {file}::{name}"


def drawn():
    """Rooms of the diagram in its order, and its arrows."""
    text = (ROOT / "docs" / "architecture.md").read_text()
    chains = [chain.split(" --> ") for chain in ARROWS.findall(text)]
    return NODE.findall(text), [pair for chain in chains for pair in itertools.pairwise(chain)]


def test_the_diagram_has_the_rooms_and_what_leads_to_them():
    nodes, arrows = drawn()
    rooms = [room.removeprefix("lorasp_jax.") for room in test_imports.ROOMS]
    assert nodes == rooms
    reached = {room: {room} for room in rooms}
    for room in rooms:
        for above, below in arrows:
            if below == room:
                reached[room] |= reached[above]
    for path in test_imports.SOURCES:
        own = test_imports.room(".".join(path.relative_to(ROOT).with_suffix("").parts))
        others = {test_imports.room(name) for name in test_imports.imported(path)} - {None}
        missing = {rooms[other] for other in others} - reached[rooms[own]]
        assert not missing, f"{path} imports {missing}: draw an arrow to {rooms[own]}"
