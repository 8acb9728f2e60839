"""Check the files and sizes that an MJCF file asks for before MuJoCo loads it.

MuJoCo searches for a file in several places: beside the main file, beside the including file, and
in meshdir, texturedir and assetdir relative to these. Files in any of them are checked.
"""

import graphlib
import itertools
import math
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from lorasp_jax.base.files import check_memory, check_regular, read_text

_FOLDERS = ("assetdir", "meshdir", "texturedir")  # attributes of <compiler>
_DESCRIPTIONS = ("include", "model")  # elements that refer to another MJCF file
_EXPANDED = ("include", "attach")  # elements replaced by the content of another MJCF file
# Limits are our choices, far above the needs of any robot. At _MAX_COPIES and _MAX_ELEMENTS, MuJoCo
# 3.17 takes seconds (measured).
_MAX_DEPTH, _MAX_TEXT = 20, 2**25
_MAX_COPIES, _MAX_ELEMENTS = 1000, 10_000
_MAX_ENTRIES, _MAX_PATHS = 10**6, 10**5
_ENTRIES = {"dim", "num", "nsample"}  # attributes of sensors and actuators
_MAX_RINGS = 300  # rings per built-in mesh, and vertices per ring
_BYTES = ("memory", "nstack")  # attributes of <size> that `reading` ignores
_PIXEL_BYTES = 4
_PNG = b"\x89PNG\r\n\x1a\n"


def check(path: Path, folder: Path) -> None:
    """Check that an MJCF file refers only to files inside a folder and asks for reasonable sizes.

    Raises:
        ValueError: a file is outside of the folder once links are resolved, or a size is too large.
    """
    descriptions = _all_descriptions(path, folder)
    for root in descriptions.values():
        for element in root.iter():
            _check_sizes(element)
    _check_growth(descriptions, path.parent)
    for file in _referenced(descriptions, path.parent, ()):
        _check_image(check_regular(file, folder))


def _all_descriptions(path: Path, folder: Path) -> dict[Path, ElementTree.Element]:
    """Parse a file and all MJCF files that it includes, directly or indirectly."""
    check_regular(path)
    main, known, new, size = path.parent, {}, [path], 0
    for _ in range(_MAX_DEPTH):
        for file in new:
            text = read_text(file, folder if known else None)
            if (size := size + len(text)) > _MAX_TEXT:
                raise ValueError(f"its XML is longer than {_MAX_TEXT} characters")
            known[file] = ElementTree.fromstring(text)  # the parser limits entity expansion
        new = [p for p in _referenced(known, main, _DESCRIPTIONS) if p not in known]
        if not new:
            return known
    raise ValueError(f"{new[0]} is included more than {_MAX_DEPTH} files deep")


def _check_growth(descriptions: dict[Path, ElementTree.Element], main: Path) -> None:
    """Raise a ValueError if a file includes itself, or expands to too many elements.

    MuJoCo would crash on a cycle, and loads in time quadratic in the number of elements.
    """
    included: dict[Path, set[Path]] = {}
    for path, root in descriptions.items():
        names = [_portable(e.get("file", "")) for e in root.iter() if e.tag in _DESCRIPTIONS]
        folders = (main, path.parent)
        included[path] = {
            Path(os.path.normpath(folder / name)) for folder in folders for name in names if name
        }
    sizes: dict[Path, float] = {}
    try:
        order = [*graphlib.TopologicalSorter(included).static_order()]  # included files first
    except graphlib.CycleError as error:
        cycle = error.args[1][0]
        raise ValueError(f"{cycle} includes itself, through its includes and models") from None
    for path in order:
        if path in descriptions:
            inner = max((sizes.get(file, 0.0) for file in included[path]), default=0.0)
            sizes[path] = _elements(descriptions[path], 1, inner)
            if sizes[path] > _MAX_ELEMENTS:
                raise ValueError(f"{path} expands to more than {_MAX_ELEMENTS} elements")


def _elements(element: ElementTree.Element, copies: float, inner: float) -> float:
    """Return a bound on the elements that `element` expands to, with `inner` per included file."""
    more = inner if element.tag in _EXPANDED else 0.0
    below = copies * _copies(element)
    return copies * (1 + more) + sum(_elements(child, below, inner) for child in element)


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
    if math.prod(map(len, parts)) > _MAX_PATHS:
        raise ValueError(f"its file names and folders combine to more than {_MAX_PATHS} paths")
    paths = {os.path.normpath(os.path.join(*path)) for path in itertools.product(*parts)}
    yield from (Path(p) for p in sorted(paths) if os.path.lexists(p) and not os.path.isdir(p))


def _portable(name: str) -> str:
    """Replace backslashes, which MuJoCo also accepts, by slashes."""
    return name.replace("\\", "/")


def _check_sizes(element: ElementTree.Element) -> None:
    """Raise a ValueError if an element asks for something too large."""
    grid = math.prod([*_numbers(element, "nrow"), *_numbers(element, "ncol")])
    image = math.prod([*_numbers(element, "width"), *_numbers(element, "height")])
    counted = element.attrib.keys() & _ENTRIES
    if element.tag == "size":
        counted = element.attrib.keys() - set(_BYTES)
    if element.tag == "numeric":
        counted = {"size"}
    entries = max(itertools.chain(*(_numbers(element, name) for name in counted)), default=0)
    rings = max(_numbers(element, "params"), default=0)
    for what, number, limit in (
        ("entries", entries, _MAX_ENTRIES),
        ("rings", rings, _MAX_RINGS),
        ("copies", _copies(element), _MAX_COPIES),
    ):
        if number > limit:
            raise ValueError(f"its {element.tag} has {number:g} {what}, more than {limit}")
    check_memory(int(min(_PIXEL_BYTES * max(grid, image), 1e30)), f"its {element.tag}")


def _copies(element: ElementTree.Element) -> float:
    """Return how many copies an element makes of its children."""
    return math.prod(_numbers(element, "count"))


def _numbers(element: ElementTree.Element, attribute: str) -> list[float]:
    """Parse an attribute's numbers, each at least 1; MuJoCo reports malformed ones."""
    try:
        return [max(1.0, float(text)) for text in element.get(attribute, "").split()]
    except ValueError:
        return []


def _check_image(path: Path) -> None:
    """Raise a ValueError if the header of a PNG file claims a size that does not fit in memory."""
    with path.open("rb") as file:
        head = file.read(24)
    if head.startswith(_PNG) and len(head) == 24:
        width, height = struct.unpack(">2I", head[16:])
        check_memory(_PIXEL_BYTES * width * height, path)
