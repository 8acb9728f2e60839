"""Test pictures that clients send as JPEG: what arrives, and what a server refuses."""

import io
import time

import numpy as np
import pytest
from PIL import Image

from lorasp_jax.extras.serving import jpeg, wire
from lorasp_jax.extras.serving.client import PolicyClient, PolicyError
from tests.extras.serving.stand_in import SPEC, StandIn, connect, observation, serving
from tests.extras.serving.test_pictures import smooth


@pytest.fixture(scope="module")
def server():
    with serving(StandIn()) as server:
        yield server


def file(picture, **options):
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "JPEG", **options)
    return stream.getvalue()


def with_size(height, width):
    """Return a small JPEG whose header declares another size."""
    data = bytearray(file(smooth(16, 16)))
    start = data.index(b"\xff\xc0") + 5
    data[start : start + 4] = height.to_bytes(2) + width.to_bytes(2)
    return bytes(data)


@pytest.mark.parametrize("form", ["HWC", "CHW", "float"])
def test_pictures_survive(form):
    picture = smooth(48, 64)
    sent = {"HWC": picture, "CHW": picture.transpose(2, 0, 1), "float": (picture + 0.5) / 256}
    found = jpeg.decode("x", jpeg.encode("x", sent[form], 95))
    assert (found.dtype, found.shape) == (np.uint8, picture.shape)
    assert np.abs(found.astype(int) - picture).mean() < 2
    assert jpeg.decode("x", file(picture[..., 0])).shape == picture.shape  # gray


def test_clients_send_jpeg_if_asked(server):
    """Every array with three axes is one, in any form of a request; nothing else changes."""
    picture = smooth(224, 224)
    request = observation() | {"image": dict.fromkeys(SPEC.cameras, picture)}
    flat = {"observation/image": picture, "observation/state": np.zeros(3)}
    compressed = jpeg.compress(flat, 90)
    assert isinstance(compressed["observation/image"], bytes)
    assert compressed["observation/state"] is flat["observation/state"]
    assert len(wire.pack(jpeg.compress(request, 90))) < len(wire.pack(request)) / 10
    means = []
    for quality in (None, 90):
        with connect(server, jpeg=quality) as client:
            assert "jpeg" in client.metadata["encodings"]
            means.append(client.infer(request)["actions"][0])
    np.testing.assert_allclose(*means, atol=1)  # the stand-in returns the mean of a picture
    assert (means[0] != means[1]).any()


def test_servers_that_do_not_read_jpeg(monkeypatch):
    monkeypatch.setattr("lorasp_jax.extras.serving.server.describe", lambda _: {"encodings": None})
    with serving(StandIn()) as server:
        connect(server).close()
        with pytest.raises(ValueError, match="does not read JPEG"):
            connect(server, jpeg=90)


@pytest.mark.parametrize("quality", [0, 101, -1])
def test_qualities(quality):
    with pytest.raises(ValueError, match=f"1 to 100, got {quality}"):
        PolicyClient("ws://127.0.0.1:1", jpeg=quality)


def test_only_pictures_are_compressed():
    with pytest.raises(ValueError, match=r"side must be a picture .*\(4, 4, 4\)"):
        jpeg.compress({"image": {"side": np.zeros((4, 4, 4), np.uint8)}}, 90)


GOOD = file(smooth(16, 16))
UNDAMAGED = "image/side must be an array or an undamaged JPEG"
REFUSED = [
    (b"nothing", UNDAMAGED),
    (GOOD[:20], UNDAMAGED),
    (GOOD[:-50], UNDAMAGED),
    (with_size(2**16 - 1, 2**16 - 1), "image/side .* pixels as JPEG, got 65535 x 65535"),
    (with_size(2**12, 2**12), "image/side .* pixels as JPEG, got 4096 x 4096"),
    (GOOD + bytes(jpeg.MAX_BYTES), "image/side .* bytes as JPEG"),
    (GOOD[:-2] + 5 * GOOD[GOOD.index(jpeg._SCAN) : -2] + GOOD[-2:], "image/side .* 4 scans, got 6"),
    (file(smooth(64, 64), progressive=True), "image/side .* 4 scans, got 10"),
]


@pytest.mark.parametrize(("data", "refusal"), REFUSED)
def test_a_bad_file_is_refused_in_a_sentence(data, refusal, server):
    """The bystander's connection goes on, and nothing large was decoded."""
    request = observation()
    with connect(server) as bystander, connect(server) as client:
        bystander.infer(request)
        start = time.monotonic()
        with pytest.raises(PolicyError, match=refusal) as caught:
            client.infer(request | {"image": {**request["image"], "side": data}})
        assert time.monotonic() - start < 2
        assert "\n" not in str(caught.value)
        assert bystander.infer(request)["actions"].shape == (10, 7)


def test_damaged_files_never_raise_anything_else():
    rng = np.random.default_rng(0)
    good, sentences = file(smooth(32, 32)), []
    for _ in range(500):
        data = bytearray(good[: rng.integers(1, len(good) + 1)])
        for _ in range(rng.integers(0, 8)):
            data[rng.integers(len(data))] = rng.integers(256)
        try:
            picture = jpeg.decode("x", bytes(data))
        except ValueError as error:
            sentences.append(str(error))
        else:
            assert (picture.dtype, picture.ndim, picture.shape[2]) == (np.uint8, 3, 3)
    assert 250 < len(sentences) < 500
    assert all(text.startswith("x must ") for text in sentences)
