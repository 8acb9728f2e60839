"""Test the frames: what goes in comes out, and what lies about itself is refused."""

import ml_dtypes
import msgpack
import numpy as np
import pytest

from lorasp_jax.extras.serving import wire
from lorasp_jax.extras.serving.wire import FrameError, pack, unpack


def array(data=b"\0" * 24, dtype="<f4", shape=(2, 3), **extra):
    return {b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": shape, **extra}


@pytest.mark.parametrize("dtype", [*sorted(wire.NUMERIC), ">f4", ">i2", "<U5", "S3"])
@pytest.mark.parametrize("shape", [(), (0,), (3,), (2, 3), (1, 0, 4)])
def test_arrays_survive(dtype, shape):
    value = np.arange(np.prod(shape, dtype=int)).astype(dtype).reshape(shape)
    result = unpack(pack({"x": value}))["x"]
    assert (result.dtype, result.shape) == (value.dtype, value.shape)
    np.testing.assert_array_equal(result, value)


def test_other_values_survive():
    message = {"a": [1, 2.5, None, True, "text", b"bytes"], "b": {"c": {}}}
    assert unpack(pack(message)) == message
    scalar = unpack(pack(np.float32(1.5)))
    assert (scalar, type(scalar)) == (1.5, np.float32)


def test_non_contiguous_arrays_survive():
    value = np.arange(24).reshape(2, 3, 4)
    np.testing.assert_array_equal(unpack(pack(value.T)), value.T)
    np.testing.assert_array_equal(unpack(pack(value[:, ::2])), value[:, ::2])


def test_arrays_are_not_copied():
    assert not unpack(pack(np.zeros(3))).flags.owndata


def test_bfloat16_is_sent_as_float32():
    result = unpack(pack(np.array([1.5, -2], ml_dtypes.bfloat16)))
    assert result.dtype == np.float32
    assert result.tolist() == [1.5, -2]


@pytest.mark.parametrize(
    "value",
    [object(), {1, 2}, 1j, np.array(1j), np.array([None]), np.zeros(2, "f4,i4")],
    ids=["object", "set", "complex", "complex array", "object array", "structured array"],
)
def test_other_values_are_refused(value):
    with pytest.raises(TypeError, match=r"a message cannot contain an? "):
        pack({"x": value})


LIES = {
    "too little data": array(b"\0" * 23),
    "too much data": array(b"\0" * 25),
    "no data": array(None),
    "text as data": array("0" * 24),
    "an object array": array(dtype="|O"),
    "a structured array": array(dtype="f4,f4"),
    "a subarray": array(dtype="(2,)f4"),
    "a void": array(dtype="V4"),
    "complex numbers": array(dtype="<c8"),
    "dates": array(dtype="<M8[s]"),
    "a dtype that is no text": array(dtype=4),
    "a long dtype": array(dtype="<f4" + " " * 100),
    "huge text": array(dtype="<U999999"),
    "empty text": array(b"", dtype="<U0"),
    "foreign digits": array(dtype="<U\u0663"),
    "no shape": array(shape=None),
    "a negative size": array(shape=[-2, -3]),
    "a huge size": array(b"", shape=[2**40, 2**40, 0]),
    "a boolean size": array(b"\0" * 4, shape=[True]),
    "a fractional size": array(shape=[2.0, 3]),
    "high rank": array(b"\0" * 4, shape=[1] * 9),
    "a nested shape": array(shape=[[2], 3]),
    "a scalar that does not fit": {b"__npgeneric__": True, b"data": 300, b"dtype": "|i1"},
    "a scalar without data": {b"__npgeneric__": True, b"dtype": "<f4"},
    "a scalar of text": {b"__npgeneric__": True, b"data": "x", b"dtype": "<f4"},
}


@pytest.mark.parametrize("lie", LIES)
def test_arrays_that_lie_are_refused(lie):
    with pytest.raises(FrameError):
        unpack(msgpack.packb({"x": LIES[lie]}))


@pytest.mark.parametrize(
    "frame",
    [
        b"",
        b"\xc1",
        pack({"x": 1})[:-1],
        pack({"x": 1}) + b"\0",
        b"\xdd\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\x91" * 5000,
        b"\x81\xc0\x01",
        msgpack.packb(msgpack.ExtType(5, b"abc")),
        msgpack.packb(msgpack.Timestamp(1)),
        b"\xa2\xff\xff",
    ],
    ids=[
        "empty", "unused code", "truncated", "too long", "huge list", "huge map", "huge bytes",
        "deep", "key that is no text", "extension", "time", "invalid UTF-8",
    ],
)  # fmt: skip
def test_frames_that_are_no_messages_are_refused(frame):
    with pytest.raises(FrameError, match=r"^the frame is not a msgpack message: .") as refusal:
        unpack(frame)
    assert "\n" not in str(refusal.value)


def test_frames_of_very_many_values_are_refused():
    with pytest.raises(FrameError, match="at most 65536 values"):
        unpack(msgpack.packb([[0] * 1000] * 100))
    with pytest.raises(FrameError, match="at most 33554432 bytes"):
        unpack(bytes(wire.MAX_FRAME + 1))
