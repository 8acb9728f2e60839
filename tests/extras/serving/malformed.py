"""Frames that no well-behaved client sends, drawn from a seed."""

import msgpack
import numpy as np

from lorasp_jax.extras.serving import wire
from tests.extras.serving.stand_in import SPEC, observation

VALUES = (
    None, True, -1, 2**63, 1e300, float("nan"), "", "x" * 2000, b"\xff", [], {}, [[]], ["a", 1],
    {b"a": 1}, {"a": {"b": {}}}, np.zeros(0), np.zeros((2, 2)), np.full(7, np.nan),
    np.full(7, np.inf), np.zeros(7, bool), np.array("text"), np.zeros((1,) * 8),
    np.zeros((16, 16, 3)) * np.nan, np.full((16, 16, 3), 300.0), np.zeros((16, 16, 4), np.uint8),
    np.zeros((16, 16), np.uint8), np.zeros((0, 16, 3), np.uint8), np.zeros((3, 3, 3), np.int64),
    np.zeros((9000, 1, 3), np.uint8), np.float16(1), np.bool_(True),
)  # fmt: skip
"""Values of wrong types, shapes and ranges."""
HEADERS = {
    b"dtype": (
        "|O", "V8", "<c16", "<M8[s]", "f4,f4", "(7,)f4", "", 3, None, "<f4" * 9, "<f4" + " " * 9,
        "<U0", "<U\u0663", "<U4096", "<U999999", ">f8", "|u1",
    ),
    b"shape": (
        [], [0], [-1], [-7, -1], [2**62, 4], [2**33], [2**40, 0], [7.0], [True], None, 7, [[7]],
        [7] + [1] * 8, [1] * 100, [16, 16],
    ),
    b"data": (b"", b"\0", b"\0" * 27, b"\0" * 29, None, 7, "text", "0" * 28, [1, 2]),
}  # fmt: skip
"""Values of the fields that describe an array, none of which fits those of `HONEST`."""
HONEST = {
    b"__ndarray__": True,
    b"data": bytes(4 * SPEC.state_dim),
    b"dtype": "<f4",
    b"shape": [SPEC.state_dim],
}


def malformed_frames(number, seed=0):
    """Yield frames, most of them malformed in one way, some in several."""
    rng = np.random.default_rng(seed)
    kinds = (_damaged, _truncated, _noise, _wrong_value, _missing_key, _lying_array, _huge)
    for i in range(number):
        yield kinds[i % len(kinds)](rng)


def _damaged(rng):
    frame = bytearray(wire.pack(observation()))
    # Half of the damage is in the maps' headers, which are few of the bytes.
    end = 120 if rng.random() < 0.5 else len(frame)
    for position in rng.integers(0, end, rng.integers(1, 9)):
        frame[position] = rng.integers(256)
    return bytes(frame)


def _truncated(rng):
    frame = wire.pack(observation())
    return frame[: rng.integers(len(frame))]


def _noise(rng):
    return rng.bytes(rng.integers(0, 300))


def _wrong_value(rng):
    message = observation()
    target = message["image"] if rng.random() < 0.5 else message
    key = rng.choice(sorted(target))
    if target is message and rng.random() < 0.4:
        key = rng.choice(["adapter", "reset", "images", "observation/state", "joints"])
    target[str(key)] = VALUES[rng.integers(len(VALUES))]
    return wire.pack(message)


def _missing_key(rng):
    message = observation()
    target = message["image"] if rng.random() < 0.5 else message
    del target[str(rng.choice([key for key in target if key != "prompt"]))]
    return wire.pack(message)


def _lying_array(rng):
    fields = dict(HONEST)
    for key in rng.choice(sorted(HEADERS), rng.integers(1, 4), replace=False):
        values = HEADERS[bytes(key)]
        fields[bytes(key)] = values[rng.integers(len(values))]
    if rng.random() < 0.2:
        del fields[bytes(rng.choice(sorted(HEADERS)))]
    message = observation()
    message["state"] = fields
    return msgpack.packb(message, default=wire._encode)


def _huge(rng):
    """Return a short frame that declares up to 4 GB."""
    code = rng.choice([0xC6, 0xC9, 0xDB, 0xDD, 0xDF])
    head = bytes([code]) + rng.bytes(4)
    return head if rng.random() < 0.5 else b"\x81\xa5state" + head * int(rng.integers(1, 200))
