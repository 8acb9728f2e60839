"""MkDocs hooks: add the README as the home page, files outside docs/, and the API reference.

The Markdown links work on GitHub; these hooks rewrite those that leave docs/.
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
    "study": ["lorasp_jax.extras.study"],
    "envs": [
        "envs",
        "envs.mjcf",
        "envs.robots.piper",
        "envs.datasets.rlds",
        "envs.interop.gymnasium",
        "envs.interop.brax",
        "lorasp_jax.base.compilation_cache",
    ],
}
"""API pages and the public modules on each."""
OUTSIDE = (
    "assets/**/*.gif",
    "assets/*.png",
    "assets/README.md",
    "deploy/README.md",
    "examples/*/README.md",
    "notebooks/*.ipynb",
    "studies/*/README.md",
    "studies/performance/peers.md",
    "studies/**/*.svg",
    "studies/**/*.webp",
    "CONTRIBUTING.md",
    "LICENSE",
    "CITATION.cff",
)
"""Files outside docs/ that pages link to; the site gets copies."""
REFERENCE, REFERENCE_PAGE = "lorasp_jax/peft/lora_sp/reference.py", "methods/reference.md"
"""Source file that pages link to, and the page that shows it."""
LINK = re.compile(r"(\]\(|src=\"|srcset=\")(?![a-z]+:|#)([^)\"#]+)")
PICTURE = re.compile(
    r"<picture>.*?srcset=\"(?P<dark>[^\"]+)\".*?"
    r"alt=\"(?P<alt>[^\"]*)\" src=\"(?P<light>[^\"]+)\".*?</picture>",
    re.DOTALL,
)


def public_names(module: str) -> list[str]:
    """Return the public names: `__all__`, the imports of the stub, or what the module defines."""
    file = source_file(module)
    body = ast.parse(file.read_text()).body
    if file.suffix == ".pyi":
        names = [a.name for node in body if isinstance(node, ast.ImportFrom) for a in node.names]
        return sorted(names, key=str.lower)
    for node in body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return sorted(ast.literal_eval(node.value), key=str.lower)
    kinds = (ast.FunctionDef, ast.ClassDef)
    defined = [node.name for node in body if isinstance(node, kinds)]
    return [name for name in defined if not name.startswith("_")]


def source_file(module: str) -> Path:
    """Return the file that lists the names of a module: the stub, if it has one."""
    path = ROOT / module.replace(".", "/")
    if not path.is_dir():
        return path.with_suffix(".py")
    stub = path / "__init__.pyi"
    return stub if stub.exists() else path / "__init__.py"


def is_module(parent: str, name: str) -> bool:
    """Return whether a public name is a module, like `lorasp_jax.peft`."""
    for node in ast.walk(ast.parse(source_file(parent).read_text())):
        if isinstance(node, ast.ImportFrom) and name in {a.name for a in node.names}:
            origin = f"{parent}." * node.level + (node.module or "")
            path = ROOT / origin.replace(".", "/") / name
            return path.is_dir() or path.with_suffix(".py").is_file()
    return False


def api_page(title: str, modules: list[str]) -> str:
    """Return the Markdown of an API page: a mkdocstrings directive for every public name."""
    parts = [f"# {title}"]
    for module in modules:
        parts += [f"# `{module}`"] * (len(modules) > 1)
        for name in public_names(module):
            options = "\n    options:\n      members: false" * is_module(module, name)
            parts.append(f"::: {module}.{name}{options}")
    return "\n\n".join(parts) + "\n"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the home page, the API pages and the files outside docs/."""
    readme = (ROOT / "README.md").read_text()
    files.append(File.generated(config, "index.md", content=readme))
    for title, modules in API.items():
        page = api_page(title, modules)
        files.append(File.generated(config, f"api/{title}.md", content=page))
    reference = f"# LoRA-SP in 60 lines\n\n```python\n{(ROOT / REFERENCE).read_text()}```\n"
    files.append(File.generated(config, REFERENCE_PAGE, content=reference))
    for pattern in OUTSIDE:
        for file in sorted(ROOT.glob(pattern)):
            uri = file.relative_to(ROOT).as_posix()
            files.append(File.generated(config, uri, abs_src_path=str(file)))
    return files


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the API pages to the navigation."""
    assert config.nav is not None
    config.nav.append({"API": [{title: f"api/{title}.md"} for title in API]})
    return config


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Rewrite links that are relative to the repository as links within the site."""
    uri = page.file.src_uri
    if uri.startswith("api/") or uri == REFERENCE_PAGE:
        return markdown
    pages = {"README.md": "index.md", REFERENCE: REFERENCE_PAGE}
    outside = uri == "index.md" or (ROOT / uri).is_file()
    folder = posixpath.dirname(uri if outside else f"docs/{uri}")

    def rewrite(match: re.Match) -> str:
        target = posixpath.normpath(posixpath.join(folder, match[2]))
        target = pages.get(target, target.removeprefix("docs/"))
        here = posixpath.dirname(uri) or "."
        return match[1] + posixpath.relpath(target, here)

    return PICTURE.sub(images_by_scheme, LINK.sub(rewrite, markdown))


def images_by_scheme(match: re.Match) -> str:
    """Return Markdown for an image that follows the site's light/dark switch."""
    image = "![{alt}]({path}#only-{scheme})"
    return "\n".join(
        image.format(alt=match["alt"], path=match[scheme], scheme=scheme)
        for scheme in ("light", "dark")
    )
