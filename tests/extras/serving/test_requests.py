"""Test the request forms: openpi's examples are understood, and mistakes get a sentence."""

import dataclasses
import re

import numpy as np
import pytest

from lorasp_jax.extras.serving.requests import MAX_PROMPT, PolicySpec, parse
from tests.extras.serving.stand_in import SPEC, observation

PICTURE = np.full((224, 224, 3), 9, np.uint8)
PI0 = PolicySpec(("base", "left", "right"), 224, state_dim=8, chunk=10, masks_missing=True)
ALOHA_CAMERAS = ("cam_high", "cam_low", "cam_left_wrist", "cam_right_wrist")
EXAMPLES = {
    "LIBERO": {
        "observation/state": np.zeros(8),
        "observation/image": PICTURE,
        "observation/wrist_image": PICTURE,
    },
    "DROID": {
        "observation/exterior_image_1_left": PICTURE,
        "observation/wrist_image_left": PICTURE,
        "observation/joint_position": np.zeros(7),
        "observation/gripper_position": np.zeros(1),
    },
    "ALOHA": {
        "state": np.ones(14),
        "images": dict.fromkeys(ALOHA_CAMERAS, PICTURE.transpose(2, 0, 1)),
    },
    "UR5": {"joints": np.zeros(6), "gripper": 0.5, "base_rgb": PICTURE, "wrist_rgb": PICTURE},
}
"""openpi's example requests (examples/simple_client/main.py, examples/ur5/README.md)."""


def test_our_own_form():
    request = parse(observation(value=3, adapter="pour", reset=True), SPEC)
    assert request.images.keys() == {"side", "wrist"}
    assert (request.images["side"] == 3).all()
    assert request.state.tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert (request.prompt, request.adapter, request.reset) == ("go", "pour", True)
    assert request.actions is None


@pytest.mark.parametrize(
    ("form", "dims", "cameras", "actions"),
    [("LIBERO", 8, 2, 7), ("DROID", 8, 2, 8), ("ALOHA", 14, 3, 14), ("UR5", 7, 2, 7)],
)
def test_forms_of_openpi(form, dims, cameras, actions):
    request = parse(EXAMPLES[form], dataclasses.replace(PI0, state_dim=dims))
    assert tuple(request.images) == PI0.cameras[:cameras]
    assert all((image == PICTURE).all() for image in request.images.values())
    assert (request.state.shape, request.state.dtype) == ((dims,), np.float32)
    assert (request.actions, request.adapter, request.reset) == (actions, None, False)


def test_wrist_pictures_of_aloha_may_be_missing():
    message = EXAMPLES["ALOHA"] | {"images": {"cam_high": PICTURE}}
    spec = dataclasses.replace(PI0, state_dim=14)
    assert parse(message, spec).images.keys() == {"base"}
    with pytest.raises(ValueError, match="picture images/cam_left_wrist"):
        parse(message, dataclasses.replace(spec, masks_missing=False))
    with pytest.raises(ValueError, match="picture images/cam_high"):
        parse(message | {"images": {"cam_low": PICTURE}}, spec)


def test_a_policy_that_needs_all_cameras_refuses_forms_with_fewer():
    with pytest.raises(ValueError, match=r"needs 3 cameras .base, left, right., but LIBERO .* 2"):
        parse(EXAMPLES["LIBERO"], dataclasses.replace(PI0, masks_missing=False))


@pytest.mark.parametrize("prompt", [b"go", np.str_("go"), np.array("go"), np.array(b"go")])
@pytest.mark.parametrize(
    "state",
    [
        *([0.0] * 7, np.zeros(7, int), np.zeros(7, ">f8")),
        [*np.zeros(6, np.float32), np.int64(0)],
        [*[np.array(0.0)] * 6, 0],
    ],
)
def test_values_of_other_types(prompt, state):
    request = parse(observation() | {"prompt": prompt, "state": state}, SPEC)
    assert (request.prompt, request.state.dtype) == ("go", np.float32)


@pytest.mark.parametrize(
    ("changes", "refusal"),
    [
        ({"state": np.zeros(6)}, "state must have 7 values, got 6"),
        ({"state": np.full(7, np.nan)}, "state must be finite"),
        ({"state": np.full(7, 1e300)}, "state must be finite"),
        ({"state": np.zeros((1, 7))}, "state must have one axis, got shape (1, 7)"),
        ({"state": [0, "0"]}, "state must be numbers, got a list with a value of type str"),
        (
            {"state": [np.zeros(7)]},
            "state must be numbers, got a list with a value of type ndarray",
        ),
        ({"state": [np.True_] * 7}, "with a value of type bool"),
        ({"state": {"x": 0, b"y": 1}}, "state must be numbers, got a map with the keys x, b'y'"),
        ({"state": np.zeros(7, bool)}, "state must be numbers"),
        ({"state": True}, "state must be numbers, got bool"),
        ({"state": None}, "state must be numbers, got NoneType"),
        ({"reset": 1}, "reset must be true or false, got int"),
        ({"adapter": 3}, "adapter must be text"),
        ({"prompt": ""}, "prompt must be text"),
        ({"prompt": "x" * (MAX_PROMPT + 1)}, "got 1001 characters"),
        ({"prompt": b"\xff"}, "prompt must be UTF-8"),
        ({"image": {"side": PICTURE}}, "picture image/wrist"),
        ({"image": 3}, "picture image/side"),
        ({"executed": 11}, "executed must be an integer from 0 to 10, got 11"),
        ({"executed": -1}, "got -1"),
        ({"executed": 2.0}, "got 2.0"),
        ({"executed": True}, "got True"),
        ({"executed": 0, "delay": "1"}, "delay must be an integer"),
        ({"delay": 1}, "delay counts from executed"),
        ({"delay": -1}, "delay must be an integer from 0 to 10, got -1"),
        ({"executed": 6, "delay": 5}, "at most 10 together"),
    ],
)
def test_mistakes(changes, refusal):
    with pytest.raises(ValueError, match=re.escape(refusal)):
        parse(observation() | changes, dataclasses.replace(SPEC, execution="guided"))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, (None, 0)),
        ({"delay": 0}, (None, 0)),
        ({"executed": 4, "delay": 6}, (4, 6)),
        ({"executed": 10}, (10, 0)),
    ],
)
def test_continuing_a_chunk(changes, expected):
    request = parse(observation(**changes), dataclasses.replace(SPEC, execution="trained"))
    assert (request.executed, request.delay) == expected
    if request.executed is not None:
        with pytest.raises(ValueError, match="--execution trained or guided"):
            parse(observation(**changes), SPEC)


@pytest.mark.parametrize("message", [None, 3, [], {b"state": 1}, {3: 4}])
def test_requests_that_are_no_maps(message):
    with pytest.raises(ValueError, match="map with text keys"):
        parse(message, SPEC)


@pytest.mark.parametrize("message", [{}, {"state": 1}, {"observation/state": 1, "image": 2}])
def test_unknown_forms(message):
    with pytest.raises(ValueError, match=r"one of these forms .lorasp_jax: state, image; LIBERO"):
        parse(message, SPEC)
