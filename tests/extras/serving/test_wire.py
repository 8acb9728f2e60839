"""Test the frames: what goes in comes out, and what lies about itself is refused."""

import ml_dtypes
import msgpack
import numpy as np
import pytest

from lorasp_jax.extras.serving import wire
from lorasp_jax.extras.serving.wire import FrameError, pack, unpack


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
    result = unpack(pack(np.array([1.5, -2], ml_dtypes.bfloat16)))
    assert (result.dtype, result.tolist()) == (np.float32, [1.5, -2])


@pytest.mark.parametrize(
    "value", [object(), {1, 2}, 1j, np.array(1j), np.array([None]), np.zeros(2, "f4,i4")]
)
def test_other_values_are_refused(value):
    with pytest.raises(TypeError, match=r"a message cannot contain an? "):
        pack({"x": value})


LIES = {
    "too little data": {"data": b"\0" * 23},
    "too much data": {"data": b"\0" * 25},
    "text as data": {"data": "0" * 24},
    "an object array": {"dtype": "|O"},
    "a structured array": {"dtype": "f4,f4"},
    "a subarray": {"dtype": "(2,)f4"},
    "a void": {"dtype": "V4"},
    "complex numbers": {"dtype": "<c8"},
    "a dtype that is no text": {"dtype": 4},
    "a long dtype": {"dtype": "<f4" + " " * 100},
    "huge text": {"dtype": "<U999999"},
    "empty text": {"dtype": "<U0", "data": b""},
    "foreign digits": {"dtype": "<U\u0663"},
    "no shape": {"shape": None},
    "a negative size": {"shape": [-2, -3]},
    "a huge size": {"shape": [2**40, 2**40, 0], "data": b""},
    "a boolean size": {"shape": [True], "data": b"\0" * 4},
    "a fractional size": {"shape": [2.0, 3]},
    "high rank": {"shape": [1] * 9, "data": b"\0" * 4},
    "a scalar that does not fit": {"__npgeneric__": True, "data": 300, "dtype": "|i1"},
    "a scalar of text": {"__npgeneric__": True, "data": "x"},
    "a scalar without data": {"__npgeneric__": True, "data": None},
}


@pytest.mark.parametrize("lie", LIES.values(), ids=LIES)
def test_arrays_that_lie_are_refused(lie):
    honest = {"data": b"\0" * 24, "dtype": "<f4", "shape": (2, 3)}
    kind = {} if "__npgeneric__" in lie else {"__ndarray__": True}
    fields = {key.encode(): value for key, value in (kind | honest | lie).items()}
    with pytest.raises(FrameError):
        unpack(msgpack.packb({"x": fields}))


FRAMES = {
    "empty": b"",
    "unused code": b"\xc1",
    "truncated": pack({"x": 1})[:-1],
    "too long": pack({"x": 1}) + b"\0",
    "huge list": b"\xdd\xff\xff\xff\xff",
    "huge map": b"\xdf\xff\xff\xff\xff",
    "huge bytes": b"\xc6\xff\xff\xff\xff",
    "deep": b"\x91" * 5000,
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


def test_frames_of_very_many_values_are_refused():
    with pytest.raises(FrameError, match="at most 65536 values"):
        unpack(msgpack.packb([[0] * 1000] * 100))
    with pytest.raises(FrameError, match="at most 33554432 bytes"):
        unpack(bytes(wire.MAX_FRAME + 1))
