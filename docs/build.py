"""What mkdocs adds to docs/: README as the first page, pictures from outside, pages of the API.

The Markdown stays right on GitHub; links that leave docs/ are turned here.
"""

import ast
import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
API = {
    "lorasp_jax": ["lorasp_jax"],
    "dense": ["lorasp_jax.dense"],
    "peft": ["lorasp_jax.peft"],
    "models": ["lorasp_jax.models", "lorasp_jax.models.pi0", "lorasp_jax.models.smolvla"],
    "policies": ["lorasp_jax.policies"],
    "data": ["lorasp_jax.data"],
    "training": ["lorasp_jax.training", "lorasp_jax.config"],
    "evaluation": ["lorasp_jax.evaluation"],
    "envs": [
        "envs",
        "envs.mjcf",
        "envs.robots.piper",
        "envs.datasets.rlds",
        "envs.interop.gymnasium",
        "envs.interop.brax",
        "envs.compilation.cache",
    ],
}
"""Public modules by page."""
OUTSIDE = (
    "assets/**/*.gif",
    "assets/*.png",
    "notebooks/*.ipynb",
    "CONTRIBUTING.md",
    "LICENSE",
    "CITATION.cff",
)
"""What pages link to beside docs/; the site has copies."""
REFERENCE, LISTING = "lorasp_jax/peft/lora_sp/reference.py", "methods/reference.md"
"""A source file that pages link to, and its page."""
LINK = re.compile(r"(\]\(|src=\"|srcset=\")(?![a-z]+:|#)([^)\"#]+)")
PICTURE = re.compile(
    r"<picture>.*?srcset=\"(?P<dark>[^\"]+)\".*?"
    r"alt=\"(?P<alt>[^\"]*)\" src=\"(?P<light>[^\"]+)\".*?</picture>",
    re.DOTALL,
)


def names(module: str) -> list[str]:
    """The public names of a module: its `__all__`, or what it defines without an underscore."""
    path = ROOT / module.replace(".", "/")
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    body = ast.parse(file.read_text()).body
    for node in body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return sorted(ast.literal_eval(node.value), key=str.lower)
    kinds = (ast.FunctionDef, ast.ClassDef)
    found = [node.name for node in body if isinstance(node, kinds)]
    return [name for name in found if not name.startswith("_")]


def is_module(parent: str, name: str) -> bool:
    """Whether a public name is a module, as `lorasp_jax.peft` is."""
    folder = ROOT / parent.replace(".", "/")
    file = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
    for node in ast.parse(file.read_text()).body:
        for imported in ast.walk(node):
            if isinstance(imported, ast.ImportFrom) and name in {a.name for a in imported.names}:
                home = ROOT / (imported.module or "").replace(".", "/") / name
                return home.is_dir() or home.with_suffix(".py").is_file()
    return False


def api_page(title: str, modules: list[str]) -> str:
    """Markdown from which mkdocstrings makes a page: every public name with its docstring."""
    parts = [f"# {title}"]
    for module in modules:
        parts += [f"# `{module}`"] * (len(modules) > 1)
        for name in names(module):
            alone = "\n    options:\n      members: false" * is_module(module, name)
            parts.append(f"::: {module}.{name}{alone}")
    return "\n\n".join(parts) + "\n"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the first page, the API and what lies outside of docs/."""
    readme = (ROOT / "README.md").read_text()
    files.append(File.generated(config, "index.md", content=readme))
    for title, modules in API.items():
        page = api_page(title, modules)
        files.append(File.generated(config, f"api/{title}.md", content=page))
    listing = f"# LoRA-SP in one sitting\n\n```python\n{(ROOT / REFERENCE).read_text()}```\n"
    files.append(File.generated(config, LISTING, content=listing))
    for pattern in OUTSIDE:
        for file in sorted(ROOT.glob(pattern)):
            uri = file.relative_to(ROOT).as_posix()
            files.append(File.generated(config, uri, abs_src_path=str(file)))
    return files


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the API into the navigation."""
    assert config.nav is not None
    config.nav.append({"API": [{title: f"api/{title}.md"} for title in API]})
    return config


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Turn links from where a page lies in the repository to where it lies on the site."""
    uri = page.file.src_uri
    if uri.startswith("api/") or uri == LISTING:
        return markdown
    folder = "" if uri in ("index.md", "CONTRIBUTING.md") else posixpath.dirname(f"docs/{uri}")
    pages = {"README.md": "index.md", REFERENCE: LISTING}

    def turned(match: re.Match) -> str:
        target = posixpath.normpath(posixpath.join(folder, match[2]))
        target = pages.get(target, target.removeprefix("docs/"))
        here = posixpath.dirname(uri) or "."
        return match[1] + posixpath.relpath(target, here)

    return PICTURE.sub(by_scheme, LINK.sub(turned, markdown))


def by_scheme(match: re.Match) -> str:
    """A picture that follows the site's own switch between light and dark."""
    one = "![{alt}]({path}#only-{scheme})"
    return "\n".join(
        one.format(alt=match["alt"], path=match[scheme], scheme=scheme)
        for scheme in ("light", "dark")
    )
