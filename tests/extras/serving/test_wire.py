"""Test the frames: what goes in comes out, and what lies about itself is refused."""

import ml_dtypes
import msgpack
import numpy as np
import pytest

from lorasp_jax.extras.serving import wire
from lorasp_jax.extras.serving.wire import FrameError, pack, unpack
from tests.extras.serving.malformed import HEADERS, HONEST


@pytest.mark.parametrize("dtype", [*sorted(wire.NUMERIC), ">f4", ">i2", "<U5", "S3"])
@pytest.mark.parametrize("shape", [(), (0,), (2, 3), (1, 0, 4)])
def test_arrays_survive(dtype, shape):
    value = np.arange(np.prod(shape, dtype=int)).astype(dtype).reshape(shape)
    result = unpack(pack({"x": value}))["x"]
    assert (result.dtype, result.shape) == (value.dtype, value.shape)
    np.testing.assert_array_equal(result, value)
    np.testing.assert_array_equal(unpack(pack(value.T)), value.T)
    assert not result.flags.owndata  # not copied


def test_other_values_survive():
    message = {"a": [1, 2.5, None, True, "text", b"bytes"], "b": {"c": {}}}
    assert unpack(pack(message)) == message
    scalar = unpack(pack(np.float32(1.5)))
    assert (scalar, type(scalar)) == (1.5, np.float32)


@pytest.mark.parametrize(
    "value",
    [object(), {1, 2}, 1j, np.array([None]), np.zeros(2, "f4,i4"), np.ones(2, ml_dtypes.bfloat16)],
)
def test_other_values_are_refused(value):
    with pytest.raises(TypeError, match=r"a message cannot contain an? "):
        pack({"x": value})


@pytest.mark.parametrize(
    ("key", "value"), [(key, value) for key, values in HEADERS.items() for value in values]
)
def test_arrays_that_lie_are_refused(key, value):
    assert unpack(msgpack.packb({"x": HONEST}))["x"].shape == (7,)
    with pytest.raises(FrameError):
        unpack(msgpack.packb({"x": HONEST | {key: value}}))


@pytest.mark.parametrize(("data", "dtype"), [(300, "|i1"), ("x", "<f4"), (None, "<f4"), (1, "|O")])
def test_scalars_that_lie_are_refused(data, dtype):
    with pytest.raises(FrameError):
        unpack(msgpack.packb({b"__npgeneric__": True, b"data": data, b"dtype": dtype}))


@pytest.mark.parametrize(
    "fields",
    [
        {b"nd": True, b"type": "<f8", b"kind": b"", b"shape": [3], b"data": bytes(24)},
        {b"nd": False, b"type": "<f8", b"data": bytes(8)},
        {"__ndarray__": True, "dtype": "<f8", "shape": [3], "data": bytes(24)},
    ],
    ids=["msgpack_numpy", "its scalars", "text keys"],
)
def test_arrays_of_other_encodings_are_named(fields):
    with pytest.raises(FrameError, match=r"encoded as openpi_client\.msgpack_numpy does"):
        unpack(msgpack.packb({"state": fields}))


FRAMES = {
    "empty": b"",
    "unused code": b"\xc1",
    "truncated": pack({"x": 1})[:-1],
    "too long": pack({"x": 1}) + b"\0",
    "huge bytes": b"\xc6\xff\xff\xff\xff",
    "key that is no text": b"\x81\xc0\x01",
    "extension": msgpack.packb(msgpack.ExtType(5, b"abc")),
    "time": msgpack.packb(msgpack.Timestamp(1)),
    "invalid UTF-8": b"\xa2\xff\xff",
}


@pytest.mark.parametrize("frame", FRAMES.values(), ids=FRAMES)
def test_frames_that_are_no_messages_are_refused(frame):
    with pytest.raises(FrameError, match=r"^the frame is not a msgpack message: .") as refusal:
        unpack(frame)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("head", [b"\x91", b"\x81\xa1a"])
def test_deep_frames_are_refused(head):
    unpack(head * wire.MAX_DEPTH + b"\xc0")
    with pytest.raises(FrameError, match="at most 16 deep"):
        unpack(head * (wire.MAX_DEPTH + 1) + b"\xc0")
    with pytest.raises(FrameError, match="at most 16 deep"):
        unpack(head * 5000)


def test_what_is_refused_is_never_built(monkeypatch):
    """Each frame is short, and would be many objects."""
    monkeypatch.setattr(msgpack, "unpackb", lambda *_, **__: pytest.fail("it was built"))
    many = b"\xdc\x13\x88" + b"\x80" * 5000  # empty maps
    few_each = b"\xdc\x04\x00" + (b"\x9f" + b"\xc0" * 15) * 1024
    for frame in (many, few_each):
        with pytest.raises(FrameError, match="at most 4096 values"):
            unpack(frame, max_values=4096)


def test_frames_of_very_many_values_are_refused():
    with pytest.raises(FrameError, match="at most 65536 values"):
        unpack(msgpack.packb([[0] * 1000] * 100))
    for head in (b"\xdd", b"\xdf"):
        with pytest.raises(FrameError, match="at most 65536 values"):
            unpack(head + b"\xff" * 4)
    with pytest.raises(FrameError, match="at most 33554432 bytes"):
        unpack(bytes(wire.MAX_FRAME + 1))
