"""Frames of openpi's websocket protocol: msgpack with NumPy arrays.

An array is a map with bytes keys (openpi_client/msgpack_numpy.py at 15a9616):

    {b"__ndarray__": True, b"data": raw bytes, b"dtype": "<f4", b"shape": [2, 3]}
    {b"__npgeneric__": True, b"data": 1.5, b"dtype": "<f4"}          a NumPy scalar

`unpack` never trusts a frame: it bounds depth and number of values before anything is built, and
checks dtype, rank and sizes of arrays against the length of the data before NumPy sees them.
Nothing is ever unpickled.
"""

import math
from typing import Any, cast

import msgpack
import numpy as np

MAX_FRAME = 32 * 2**20
"""Maximum size of a frame [bytes]. Four float64 pictures of 448 x 448 pixels take 19 MB."""
MAX_RANK = 8
"""Maximum number of axes of an array."""
MAX_VALUES = 65_536
"""Maximum number of values in the lists and maps of a frame, an array counts nine."""
MAX_DEPTH = 16
"""Maximum depth of lists and maps in each other; a request needs 4."""
NUMERIC = frozenset(["b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"])
"""Dtypes that a frame may contain, without byte order. Strings, such as U12, are allowed too."""
MAX_TEXT = 4096
"""Maximum length of a NumPy string [characters]."""


class FrameError(ValueError):
    """A frame violates the protocol."""


def pack(message: Any) -> bytes:
    """Encode a message of maps, lists, numbers, text and arrays.

    JAX arrays are copied to the host.

    Raises:
        TypeError: a value that the protocol cannot carry.
    """
    return cast(bytes, msgpack.packb(message, default=_encode))


def unpack(frame: bytes, *, max_values: int = MAX_VALUES) -> Any:
    """Decode a frame. Arrays are read-only views of it.

    Raises:
        FrameError: the frame is malformed, too large, or declares arrays that it does not contain.
    """
    if len(frame) > MAX_FRAME:
        raise FrameError(f"a frame must have at most {MAX_FRAME} bytes, got {len(frame)}")
    try:
        _bound(frame, max_values)
        return msgpack.unpackb(frame, object_hook=_map, max_ext_len=0)
    except FrameError:
        raise
    except IndexError as error:
        raise FrameError("the frame is not a msgpack message: it is incomplete") from error
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise FrameError(f"the frame is not a msgpack message: {reason}") from error


def _bound(frame: bytes, max_values: int) -> None:
    """Refuse a frame of very many or very deep values by its headers, without building any."""
    scan = msgpack.Unpacker(max_buffer_size=MAX_FRAME)
    scan.feed(frame)
    values, remaining = 1, [1]  # values that are still to come at each depth
    while remaining:
        if not remaining[-1]:
            remaining.pop()
            continue
        remaining[-1] -= 1
        header = frame[scan.tell()]
        if header & 0xF0 == 0x80 or header in (0xDE, 0xDF):
            remaining.append(2 * scan.read_map_header())
        elif header & 0xF0 == 0x90 or header in (0xDC, 0xDD):
            remaining.append(scan.read_array_header())
        else:
            scan.skip()
            continue
        values += remaining[-1]
        if values > max_values:
            raise FrameError(f"a frame must have at most {max_values} values, arrays apart")
        if len(remaining) > MAX_DEPTH + 1:
            raise FrameError(f"lists and maps must be at most {MAX_DEPTH} deep in each other")


def _map(fields: dict[Any, Any]) -> Any:
    """Decode the maps that are arrays."""
    if b"nd" in fields or "__ndarray__" in fields:
        raise FrameError(
            "arrays must be encoded as openpi_client.msgpack_numpy does, as a map with the "
            f"bytes keys __ndarray__, data, dtype and shape; got the keys {[*fields][:4]}"
        )
    if b"__ndarray__" in fields:
        return _array(fields)
    return _scalar(fields) if b"__npgeneric__" in fields else fields


def _encode(value: Any) -> Any:
    """Encode what msgpack cannot: arrays, NumPy scalars, and JAX arrays."""
    if not hasattr(value, "__array__"):
        raise TypeError(f"a message cannot contain a {type(value).__name__}")
    array = np.asarray(value)
    if array.dtype.kind not in "biufUS":
        raise TypeError(f"a message cannot contain an array of {array.dtype}")
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": array.item(), b"dtype": array.dtype.str}
    header = {b"__ndarray__": True, b"dtype": array.dtype.str, b"shape": array.shape}
    return {**header, b"data": array.tobytes()}


def _array(fields: dict[Any, Any]) -> np.ndarray:
    """Decode an array, after checking that its data have exactly the declared size."""
    dtype, shape, data = _dtype(fields), fields.get(b"shape"), fields.get(b"data")
    if not isinstance(shape, list) or len(shape) > MAX_RANK:
        raise FrameError(f"the shape of an array must be a list of at most {MAX_RANK} sizes")
    if not all(type(size) is int and 0 <= size <= MAX_FRAME for size in shape):
        raise FrameError(f"the sizes of an array must be integers from 0 to {MAX_FRAME}")
    expected = math.prod(shape) * dtype.itemsize
    if not isinstance(data, bytes) or len(data) != expected:
        got = f"{len(data)} bytes" if isinstance(data, bytes) else "no bytes"
        raise FrameError(f"an array {dtype} {shape} must have {expected} bytes of data, got {got}")
    return np.ndarray(shape, dtype, buffer=data)


def _scalar(fields: dict[Any, Any]) -> np.generic:
    dtype, data = _dtype(fields), fields.get(b"data")
    if not isinstance(data, bool | int | float | str | bytes):
        raise FrameError("a NumPy scalar must have a number or text as its data")
    try:
        return dtype.type(data)
    except (TypeError, ValueError, OverflowError) as error:
        raise FrameError(f"a NumPy scalar does not fit its dtype {dtype}") from error


def _dtype(fields: dict[Any, Any]) -> np.dtype:
    """Parse the dtype, which must be in a list of numeric ones, or text."""
    name = fields.get(b"dtype")
    name = name.decode("ascii", "replace") if isinstance(name, bytes) else name
    if isinstance(name, str) and len(name) <= 8:
        plain = name[1:] if name[:1] in ("<", ">", "|", "=") else name
        kind, size = plain[:1], plain[1:]
        is_text = kind in ("U", "S") and size.isdecimal() and size.isascii()
        if plain in NUMERIC or (is_text and 0 < int(size) <= MAX_TEXT):
            return np.dtype(name)
    raise FrameError(f"the dtype of an array must be numeric or text, got {str(name)[:40]!r}")
