"""Test that the documentation's examples run as is and that its tables match the code."""

import ast
import dataclasses
import itertools
import re

import pytest

from lorasp_jax import peft
from tests import ROOT, test_imports

PAGES = sorted([*ROOT.glob("docs/*.md"), *ROOT.glob("docs/methods/*.md")])
OTHERS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
OTHERS += [*sorted(ROOT.glob("studies/*/README.md")), *sorted(ROOT.glob("examples/*/README.md"))]
"""Pages whose links and files are checked, but not their examples."""
WITHOUT_EXAMPLES = {"runs", "launch", "benchmarks", "architecture", "libero", "deployment"}
WITHOUT_EXAMPLES |= {"reinforce"}
"""Reference pages, and some of commands alone."""
SLOW = {"serving", "latency", "reinforcement_learning", "simulation"}
SLOW |= {"adapt_your_model", "language_models", "published_checkpoints"}
"""Pages that take long and whose subjects have tests of their own."""
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
OPTION = re.compile(r"^\| `(\w+)` \| `([^`]+)` \| \S", re.MULTILINE)
LINK = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)|src(?:set)?=\"([^\":]+)\"")
FOLDERS = "lorasp_jax|envs|studies|benchmarks|configs|examples|tests"
FILE = re.compile(rf"`((?:{FOLDERS})/[\w/]+\.py)[`:]")
FUNCTION = re.compile(r"`([\w/]+\.py)::(\w+)`")
NODE = re.compile(r"^    (\w+)\[\"([\w, ]+)<br>", re.MULTILINE)
ARROWS = re.compile(r"^    (\w+(?: --> \w+)+)$", re.MULTILINE)
MAX_NODES = 10


def method_page(name):
    return ROOT / "docs" / "methods" / f"{name}.md"


def examples(page):
    """Join the examples of a page into one program with the page's line numbers."""
    text, lines = page.read_text(), []
    for match in BLOCK.finditer(text):
        start = text.count("\n", 0, match.start(1))
        lines += [""] * (start - len(lines)) + match[1].splitlines()
    return "\n".join(lines)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_examples_import_what_exists(page):
    nodes = ast.walk(ast.parse(examples(page)))
    imports = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
    exec(compile(ast.Module(imports, []), str(page), "exec"), {})


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=[pytest.mark.slow] * (page.stem in SLOW)) for page in PAGES],
    ids=lambda page: page.stem,
)
def test_examples_run(page, tmp_path, monkeypatch):
    code = examples(page)
    assert bool(code.strip()) != (page.stem in WITHOUT_EXAMPLES), f"{page} has no example"
    monkeypatch.chdir(tmp_path)
    exec(compile(code, str(page), "exec"), {"__name__": "documentation"})


def test_the_first_example_for_a_users_model_runs():
    code = BLOCK.search((ROOT / "docs/adapt_your_model.md").read_text())[1]
    exec(compile(code, "docs/adapt_your_model.md", "exec"), {"__name__": "documentation"})


def test_every_method_has_a_page():
    pages = {page.stem for page in PAGES if page.parent.name == "methods"}
    assert pages == set(peft.names())


@pytest.mark.parametrize("name", peft.names())
def test_option_table_matches_the_method(name):
    options = [
        (field, ast.literal_eval(d)) for field, d in OPTION.findall(method_page(name).read_text())
    ]
    fields = dataclasses.fields(peft.find(name))
    assert options == [(field.name, field.default) for field in fields]


@pytest.mark.parametrize("name", peft.names())
def test_page_uses_the_method(name):
    code = examples(method_page(name))
    assert peft.find(name).__name__ in code


@pytest.mark.parametrize("page", [*PAGES, *OTHERS], ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_names_exists(page):
    text = page.read_text()
    for link, source in LINK.findall(BLOCK.sub("", text)):
        assert (page.parent / (link or source)).exists(), f"{page} links to {link or source}"
    assert [file for file in FILE.findall(text) if not (ROOT / file).is_file()] == []
    for file, name in FUNCTION.findall(text):
        tree = ast.parse((ROOT / file).read_text())
        kinds = (ast.FunctionDef, ast.ClassDef)
        defined = {node.name for node in tree.body if isinstance(node, kinds)}
        assert name in defined, f"{page} names {file}::{name}"


def diagram():
    """Return the diagram's packages by node, and its arrows."""
    text = (ROOT / "docs" / "architecture.md").read_text()
    chains = [chain.split(" --> ") for chain in ARROWS.findall(text)]
    nodes = {node: packages.split(", ") for node, packages in NODE.findall(text)}
    return nodes, [pair for chain in chains for pair in itertools.pairwise(chain)]


def test_diagram_has_all_packages_and_imports():
    nodes, arrows = diagram()
    packages = [name.removeprefix("lorasp_jax.") for name in test_imports.PACKAGES]
    rooms = ["extras" if name.startswith("extras.") else name for name in packages]
    assert sorted(itertools.chain(*nodes.values())) == sorted(set(rooms))
    assert len(nodes) <= MAX_NODES
    node_of = {name: node for node, names in nodes.items() for name in names}
    importable = {node: {node} for node in nodes}
    for node in nodes:
        for source, target in arrows:
            if target == node:
                importable[node] |= importable[source]
    for path in test_imports.SOURCES:
        own = test_imports.package(".".join(path.relative_to(ROOT).with_suffix("").parts))
        others = {test_imports.package(name) for name in test_imports.imported(path)} - {None}
        missing = {node_of[rooms[other]] for other in others} - importable[node_of[rooms[own]]]
        assert not missing, f"{path} imports {missing}: draw an arrow to {rooms[own]}"
