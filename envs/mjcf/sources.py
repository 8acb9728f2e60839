"""Check the files that an MJCF file asks for before MuJoCo loads it.

MuJoCo searches for a file in several places: beside the main file, beside the including file, and
in meshdir, texturedir and assetdir relative to these. Files in any of them are checked.
"""

import graphlib
import itertools
import os
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from lorasp_jax.base.files import check_regular, read_text

_FOLDERS = ("assetdir", "meshdir", "texturedir")  # attributes of <compiler>
_DESCRIPTIONS = ("include", "model")  # elements that refer to another MJCF file


def check(path: Path, folder: Path) -> None:
    """Check that an MJCF file refers only to files inside a folder, and that none includes itself.

    Raises:
        ValueError: a file is outside of the folder once links are resolved, or includes itself.
    """
    descriptions = _all_descriptions(path, folder)
    _check_cycles(descriptions, path.parent)
    for file in _referenced(descriptions, path.parent, ()):
        check_regular(file, folder)


def _all_descriptions(path: Path, folder: Path) -> dict[Path, ElementTree.Element]:
    """Parse a file and all MJCF files that it includes, directly or indirectly."""
    check_regular(path)
    main, known, new = path.parent, {}, [path]
    while new:
        for file in new:
            text = read_text(file, folder if known else None)
            known[file] = ElementTree.fromstring(text)  # the parser limits entity expansion
        new = [p for p in _referenced(known, main, _DESCRIPTIONS) if p not in known]
    return known


def _check_cycles(descriptions: dict[Path, ElementTree.Element], main: Path) -> None:
    """Raise a ValueError if a file includes itself: MuJoCo would crash."""
    included: dict[Path, set[Path]] = {}
    for path, root in descriptions.items():
        names = [_portable(e.get("file", "")) for e in root.iter() if e.tag in _DESCRIPTIONS]
        folders = (main, path.parent)
        included[path] = {
            Path(os.path.normpath(folder / name)) for folder in folders for name in names if name
        }
    try:
        graphlib.TopologicalSorter(included).prepare()
    except graphlib.CycleError as error:
        cycle = error.args[1][0]
        raise ValueError(f"{cycle} includes itself, through its includes and models") from None


def _referenced(
    descriptions: dict[Path, ElementTree.Element], main: Path, kinds: tuple[str, ...]
) -> Iterator[Path]:
    """Yield the existing files that elements of these kinds (empty: all kinds) may refer to."""
    elements = [element for root in descriptions.values() for element in root.iter()]
    below = {_portable(e.get(name, "")) for e in elements for name in _FOLDERS}
    folders = {main, *(path.parent for path in descriptions)}
    names = {
        _portable(value)
        for element in elements
        for attribute, value in element.attrib.items()
        if attribute.startswith("file") and (not kinds or element.tag in kinds)
    }
    names |= {os.path.basename(name) for name in names}  # strippath drops folders
    parts = folders, below, {os.path.relpath(folder, main) for folder in folders}, names
    paths = {os.path.normpath(os.path.join(*path)) for path in itertools.product(*parts)}
    yield from (Path(p) for p in sorted(paths) if os.path.lexists(p) and not os.path.isdir(p))


def _portable(name: str) -> str:
    """Replace backslashes, which MuJoCo also accepts, by slashes."""
    return name.replace("\\", "/")
