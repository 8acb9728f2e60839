"""Test the request forms: openpi's examples are understood, and mistakes get a sentence."""

import dataclasses
import re

import numpy as np
import pytest

from lorasp_jax.extras.serving.requests import FORMS, MAX_PROMPT, PolicySpec, parse
from tests.extras.serving.stand_in import SPEC, observation

PICTURE = np.full((224, 224, 3), 9, np.uint8)
PI0 = PolicySpec(("base", "left", "right"), 224, state_dim=8, chunk=10, masks_missing=True)
LIBERO = {
    "observation/state": np.zeros(8),
    "observation/image": PICTURE,
    "observation/wrist_image": PICTURE,
    "prompt": "do something",
}
DROID = {
    "observation/exterior_image_1_left": PICTURE,
    "observation/wrist_image_left": PICTURE,
    "observation/joint_position": np.zeros(7),
    "observation/gripper_position": np.zeros(1),
    "prompt": "do something",
}
ALOHA = {
    "state": np.ones(14),
    "images": dict.fromkeys(
        ("cam_high", "cam_low", "cam_left_wrist", "cam_right_wrist"), PICTURE.transpose(2, 0, 1)
    ),
    "prompt": "do something",
}
UR5 = {"joints": np.zeros(6), "gripper": 0.5, "base_rgb": PICTURE, "wrist_rgb": PICTURE}
"""openpi's example requests (examples/simple_client/main.py, examples/ur5/README.md)."""


def changed(message, **changes):
    return {**message, **changes}


def test_our_own_form():
    request = parse(observation(value=3, adapter="pour", reset=True), SPEC)
    assert request.images.keys() == {"side", "wrist"}
    assert (request.images["side"] == 3).all()
    assert request.state.tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert (request.prompt, request.adapter, request.reset) == ("go", "pour", True)
    assert request.actions == 7


@pytest.mark.parametrize(
    ("message", "dims", "cameras", "actions"),
    [
        (LIBERO, 8, {"base", "left"}, 7),
        (DROID, 8, {"base", "left"}, 8),
        (ALOHA, 14, {"base", "left", "right"}, 14),
        (UR5, 7, {"base", "left"}, 7),
    ],
    ids=["LIBERO", "DROID", "ALOHA", "UR5"],
)
def test_forms_of_openpi(message, dims, cameras, actions):
    request = parse(message, dataclasses.replace(PI0, state_dim=dims))
    assert request.images.keys() == cameras
    assert all((image == PICTURE).all() for image in request.images.values())
    assert (request.state.shape, request.state.dtype) == ((dims,), np.float32)
    assert (request.actions, request.adapter, request.reset) == (actions, None, False)


def test_every_form_is_told_from_the_others():
    """The first form that matches is taken, so no later one may contain its keys."""
    for message, name in ((LIBERO, "LIBERO"), (DROID, "DROID"), (ALOHA, "ALOHA"), (UR5, "UR5")):
        form = next(form for form in FORMS if form.name == name)
        spec = dataclasses.replace(PI0, state_dim=form.actions + (name == "LIBERO"))
        assert parse(message, spec).actions == form.actions


def test_wrist_pictures_of_aloha_may_be_missing():
    message = changed(ALOHA, images={"cam_high": PICTURE})
    spec = dataclasses.replace(PI0, state_dim=14)
    assert parse(message, spec).images.keys() == {"base"}
    with pytest.raises(ValueError, match="must contain the picture images/cam_left_wrist"):
        parse(message, dataclasses.replace(spec, masks_missing=False))
    with pytest.raises(ValueError, match="must contain the picture images/cam_high"):
        parse(changed(ALOHA, images={"cam_low": PICTURE}), spec)


def test_a_policy_that_needs_all_cameras_refuses_forms_with_fewer():
    with pytest.raises(ValueError, match=r"needs 3 cameras .base, left, right., but LIBERO .* 2"):
        parse(LIBERO, dataclasses.replace(PI0, masks_missing=False))


@pytest.mark.parametrize("prompt", [b"go", np.str_("go"), np.array("go"), np.array(b"go")])
def test_prompts_of_other_types(prompt):
    assert parse(changed(observation(), prompt=prompt), SPEC).prompt == "go"


@pytest.mark.parametrize("state", [[0.0] * 7, np.zeros(7, int), np.zeros(7, ">f8")])
def test_states_of_other_types(state):
    assert parse(changed(observation(), state=state), SPEC).state.dtype == np.float32


NAN = np.array([np.nan] * 7)
BLANK = np.zeros((16, 16, 3), np.float32)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"state": np.zeros(6)}, "state must have 7 values, got 6"),
        ({"state": NAN}, "state must be finite"),
        ({"state": np.full(7, 1e300)}, "state must be finite"),
        ({"state": np.zeros((1, 7))}, r"state must have one axis, got shape \(1, 7\)"),
        ({"state": "0000000"}, "state must be numbers, got str"),
        ({"state": ["0"] * 7}, "state must be numbers, got list"),
        ({"state": np.zeros(7, bool)}, "state must be numbers"),
        ({"state": True}, "state must be numbers, got bool"),
        ({"state": None}, "state must be numbers, got NoneType"),
        ({"reset": 1}, "reset must be true or false, got int"),
        ({"adapter": 3}, "adapter must be text of 1 to 1000 characters, got int"),
        ({"prompt": ""}, "prompt must be text .*, got 0 characters"),
        ({"prompt": "x" * (MAX_PROMPT + 1)}, "prompt must be text .*, got 1001 characters"),
        ({"prompt": b"\xff"}, "prompt must be UTF-8 text"),
        ({"image": {"side": BLANK}}, "must contain the picture image/wrist"),
        ({"image": 3}, "must contain the picture image/side"),
    ],
)
def test_mistakes(changes, sentence):
    with pytest.raises(ValueError, match=sentence):
        parse(changed(observation(), **changes), SPEC)


def test_continuing_a_chunk():
    trained = dataclasses.replace(SPEC, execution="trained")
    for changes, expected in (
        ({}, (None, 0)),
        ({"delay": 0}, (None, 0)),
        ({"executed": 4}, (4, 0)),
        ({"executed": 4, "delay": 6}, (4, 6)),
        ({"executed": 10}, (10, 0)),
    ):
        request = parse(observation(**changes), trained)
        assert (request.executed, request.delay) == expected


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"executed": 11}, "executed must be an integer from 0 to 10, got 11"),
        ({"executed": -1}, "executed must be an integer from 0 to 10, got -1"),
        ({"executed": 2.0}, "executed must be an integer from 0 to 10, got 2.0"),
        ({"executed": True}, "executed must be an integer from 0 to 10, got True"),
        ({"executed": 0, "delay": "1"}, "delay must be an integer from 0 to 10, got 1"),
        ({"delay": 1}, "executed must be an integer from 0 to 10, got None"),
        ({"executed": 6, "delay": 5}, "must be at most 10 together, the length of a chunk"),
    ],
)
def test_mistakes_in_continuing_a_chunk(changes, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        parse(observation(**changes), dataclasses.replace(SPEC, execution="guided"))


def test_a_server_whose_chunks_are_independent_says_so():
    with pytest.raises(ValueError, match="start it with --execution trained or guided"):
        parse(observation(executed=0), SPEC)


@pytest.mark.parametrize("message", [None, 3, [], {b"state": 1}, {3: 4}])
def test_requests_that_are_no_maps(message):
    with pytest.raises(ValueError, match="must be a map with text keys"):
        parse(message, SPEC)


@pytest.mark.parametrize("message", [{}, {"state": 1}, {"observation/state": 1, "image": 2}])
def test_unknown_forms(message):
    with pytest.raises(ValueError, match=r"one of these forms .lorasp_jax: state, image; LIBERO"):
        parse(message, SPEC)
