"""What an MJCF file names and how much it asks for, checked before MuJoCo opens and makes it.

MuJoCo looks for a file in several places: beside the main file, beside the one that includes the
element, and below meshdir, texturedir and assetdir from there. Whatever lies in any of them counts.
"""

import graphlib
import itertools
import math
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from envs.datasets.files import check_memory, read_text, regular

_FOLDERS = ("assetdir", "meshdir", "texturedir")  # attributes of compiler
_DESCRIPTIONS = ("include", "model")  # elements that name another description
_HOLDING = ("include", "attach")  # elements in whose place another description's are put
_MOST_DEPTH, _MOST_TEXT = 20, 2**25
_MOST_COPIES, _MOST_ELEMENTS = 1000, 10_000  # MuJoCo 3.17 takes seconds for these (measured)
_MOST_ENTRIES, _MOST_PLACES = 10**6, 10**5
_ENTRIES = {"dim", "num", "nsample"}  # attributes of sensors and actuators
_MOST_RINGS = 300  # of a mesh that MuJoCo makes, whose vertices are as many squared
_BYTES = ("memory", "nstack")  # attributes of size that `reading` leaves out
_PIXEL_BYTES = 4
_PNG = b"\x89PNG\r\n\x1a\n"


def check(path: Path, folder: Path) -> None:
    """Raises a ValueError unless all that a file names is in a folder and of a possible size.

    Args:
        path: the MJCF file.
        folder: where all files must lie that it names, links followed.
    """
    descriptions = _all_descriptions(path, folder)
    for root in descriptions.values():
        _check_sizes(root, 1)
    _check_growth(descriptions, path.parent)
    for named in _named(descriptions, path.parent, ()):
        _check_picture(regular(named, folder))


def _all_descriptions(path: Path, folder: Path) -> dict[Path, ElementTree.Element]:
    """The XML of a file and of all that it includes."""
    regular(path)
    main, known, new, size = path.parent, {}, [path], 0
    for _ in range(_MOST_DEPTH):
        for each in new:
            text = read_text(each, folder if known else None)
            if (size := size + len(text)) > _MOST_TEXT:
                raise ValueError(f"its XML is longer than {_MOST_TEXT} characters")
            known[each] = ElementTree.fromstring(text)  # whose parser bounds what entities become
        new = [p for p in _named(known, main, _DESCRIPTIONS) if p not in known]
        if not new:
            return known
    raise ValueError(f"{new[0]} is named more than {_MOST_DEPTH} descriptions deep")


def _check_growth(descriptions: dict[Path, ElementTree.Element], main: Path) -> None:
    """Raises a ValueError if a description holds itself, which would end this process, or makes
    more elements than MuJoCo can take: its time grows with their square.
    """
    held: dict[Path, set[Path]] = {}
    for path, root in descriptions.items():
        names = [_portable(e.get("file", "")) for e in root.iter() if e.tag in _DESCRIPTIONS]
        homes = (main, path.parent)
        held[path] = {
            Path(os.path.normpath(home / name)) for home in homes for name in names if name
        }
    made: dict[Path, float] = {}
    try:
        order = [*graphlib.TopologicalSorter(held).static_order()]  # what is held comes first
    except graphlib.CycleError as error:
        raise ValueError(f"{error.args[1][0]} holds itself, by its includes and models") from None
    for path in order:
        if path in descriptions:
            inner = max((made.get(each, 0.0) for each in held[path]), default=0.0)
            made[path] = _elements(descriptions[path], 1, inner)
            if made[path] > _MOST_ELEMENTS:
                raise ValueError(
                    f"{path} makes {made[path]:g} elements; at most are {_MOST_ELEMENTS}"
                )


def _elements(element: ElementTree.Element, copies: float, inner: float) -> float:
    """How many an element makes, at most, where a description that it holds makes `inner`."""
    more = inner if element.tag in _HOLDING else 0.0
    below = copies * _copies(element)
    return copies * (1 + more) + sum(_elements(child, below, inner) for child in element)


def _named(
    descriptions: dict[Path, ElementTree.Element], main: Path, kinds: tuple[str, ...]
) -> Iterator[Path]:
    """Everything on the disk that elements of some kinds, or of all, may stand for."""
    elements = [element for root in descriptions.values() for element in root.iter()]
    below = {_portable(e.get(name, "")) for e in elements for name in _FOLDERS}
    homes = {main, *(path.parent for path in descriptions)}
    names = {
        _portable(value)
        for element in elements
        for attribute, value in element.attrib.items()
        if attribute.startswith("file") and (not kinds or element.tag in kinds)
    }
    names |= {os.path.basename(name) for name in names}  # of strippath
    parts = homes, below, {os.path.relpath(home, main) for home in homes}, names
    if math.prod(map(len, parts)) > _MOST_PLACES:
        raise ValueError("it names more files in more folders than any robot has")
    found = {os.path.normpath(os.path.join(*place)) for place in itertools.product(*parts)}
    yield from (Path(p) for p in sorted(found) if os.path.lexists(p) and not os.path.isdir(p))


def _portable(name: str) -> str:
    """MuJoCo takes both kinds of slashes."""
    return name.replace("\\", "/")


def _check_sizes(element: ElementTree.Element, copies: float) -> None:
    """Raises a ValueError if an element makes something that is too large."""
    copies *= _copies(element)
    grid = math.prod([*_numbers(element, "nrow"), *_numbers(element, "ncol")])
    picture = math.prod([*_numbers(element, "width"), *_numbers(element, "height")])
    counted = element.attrib.keys() & _ENTRIES
    if element.tag == "size":
        counted = element.attrib.keys() - set(_BYTES)
    if element.tag == "numeric":
        counted = {"size"}
    entries = max(itertools.chain(*(_numbers(element, name) for name in counted)), default=0)
    if entries > _MOST_ENTRIES:
        raise ValueError(
            f"its {element.tag} has {entries:g} of something; at most are {_MOST_ENTRIES}"
        )
    if max(_numbers(element, "params"), default=0) > _MOST_RINGS:
        raise ValueError(f"its {element.tag} is finer than {_MOST_RINGS} rings of vertices")
    if copies > _MOST_COPIES:
        raise ValueError(f"{element.tag} makes {copies:g} copies; at most are {_MOST_COPIES}")
    check_memory(int(min(_PIXEL_BYTES * max(grid, picture), 1e30)), f"its {element.tag}")
    for child in element:
        _check_sizes(child, copies)


def _copies(element: ElementTree.Element) -> float:
    """How often an element makes what is in it."""
    return math.prod(_numbers(element, "count"))


def _numbers(element: ElementTree.Element, attribute: str) -> list[float]:
    """The numbers in an attribute; MuJoCo says what is wrong with what is none."""
    try:
        return [max(1.0, float(text)) for text in element.get(attribute, "").split()]
    except ValueError:
        return []


def _check_picture(path: Path) -> None:
    """Raises a ValueError if a PNG file says that it is larger than any memory."""
    with path.open("rb") as file:
        head = file.read(24)
    if head.startswith(_PNG) and len(head) == 24:
        width, height = struct.unpack(">2I", head[16:])
        check_memory(_PIXEL_BYTES * width * height, path)
