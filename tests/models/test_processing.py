import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.models.policy import Policy
from lorasp_jax.models.processing import (
    SMALLEST_STD,
    Processor,
    Statistics,
    resize_with_pad,
    robot_slots,
)

DIM = 8
RNG = np.random.default_rng(0)
ROBOTS = {"piper": ((0, 1, 2, 3, 4, 5, 7), 6), "panda": ((0, 1, 2, 3, 4, 5, 6, 7), 7)}


def processor(num_joints: int) -> Processor:
    slots = robot_slots(num_joints)
    state = RNG.normal(2.0, 3.0, (4, 5, len(slots)))
    action = RNG.normal(-1.0, 0.5, (4, 5, len(slots)))
    valid = np.ones((4, 5), bool)
    statistics = Statistics.measure(state, action, valid, slots=slots, dim=DIM)
    tokens = jnp.array([[3, 4, 0], [5, 0, 0]])
    return Processor(slots, statistics, tokens, tokens > 0, image_size=16)


@pytest.mark.parametrize("robot", ROBOTS)
def test_slots(robot):
    slots, joints = ROBOTS[robot]
    assert robot_slots(joints) == slots
    assert np.flatnonzero(processor(joints).slot_mask).tolist() == list(slots)
    with pytest.raises(ValueError, match="1 to 7 joints here, got 8"):
        robot_slots(8)


@pytest.mark.parametrize("robot", ROBOTS)
def test_decode_inverts_normalize(robot):
    own = processor(ROBOTS[robot][1])
    actions = RNG.normal(size=(3, 4, len(own.robot_slots))).astype(np.float32)
    inside = own.normalize_actions(jnp.asarray(actions))
    assert inside.shape == (3, 4, DIM)
    assert not inside[..., ~own.slot_mask].any()
    np.testing.assert_allclose(own.decode(inside), actions, atol=1e-5)


@pytest.mark.parametrize("robot", ROBOTS)
def test_statistics_count_valid_steps_only(robot):
    slots, _ = ROBOTS[robot]
    state = RNG.normal(size=(3, 6, len(slots))).astype(np.float32)
    valid = np.arange(6) < np.array([[2], [6], [4]])
    state[..., -1] = 0.07  # a gripper that never moves
    padded = np.where(valid[..., None], state, 1e6)
    statistics = Statistics.measure(padded, padded, valid, slots=slots, dim=DIM)
    rows = state[valid]
    np.testing.assert_allclose(statistics.state_mean[np.array(slots)], rows.mean(0), atol=1e-6)
    np.testing.assert_allclose(statistics.state_std[np.array(slots[:-1])], rows.std(0)[:-1], 1e-5)
    assert statistics.action_std[7] == np.float32(SMALLEST_STD)
    unused = np.setdiff1d(np.arange(DIM), slots)
    assert (statistics.state_std[unused] == 1).all()
    with pytest.raises(ValueError, match="at least one valid step"):
        Statistics.measure(state, state, valid & False, slots=slots, dim=DIM)
    with pytest.raises(ValueError, match="as many different slots below 8"):
        Statistics.measure(state, state, valid, slots=slots[:-1], dim=DIM)


def test_statistics_survive_json():
    statistics = processor(6).statistics
    again = Statistics.from_json(statistics.to_json())
    jax.tree.map(np.testing.assert_array_equal, again, statistics)
    broken = json.loads(statistics.to_json())
    for change in ({"state_std": broken["state_std"][:-1]}, {"action_mean": "x"}, {"more": 1}):
        with pytest.raises(ValueError, match=r"statistics need lists of"):
            Statistics.from_json(json.dumps({**broken, **change}))
    with pytest.raises(ValueError, match="statistics need lists of"):
        Statistics.from_json("{}")


def test_encode():
    own = processor(6)
    image = RNG.integers(0, 256, (2, 16, 16, 3), np.uint8)
    state = RNG.normal(size=(2, 7)).astype(np.float32)
    raw = {"image": {"side": jnp.asarray(image)}, "state": jnp.asarray(state)}
    obs = jax.jit(lambda own, raw, ids: own.encode(raw, ids))(own, raw, jnp.array([1, 0]))
    np.testing.assert_allclose(obs.images["side"], image / 127.5 - 1, atol=1e-6)
    assert obs.tokens.tolist() == [[5, 0, 0], [3, 4, 0]]
    assert obs.token_mask.sum(axis=1).tolist() == [1, 2]
    assert obs.image_masks["side"].all()
    assert not obs.state[:, 6].any()
    gripper = (state[:, -1] - own.statistics.state_mean[7]) / own.statistics.state_std[7]
    np.testing.assert_allclose(obs.state[:, 7], gripper, rtol=1e-5)


def test_bad_observations_raise():
    own = processor(6)
    state = jnp.zeros((2, 7))
    with pytest.raises(ValueError, match=r"'side' needs uint8 \[B, H, W, 3\], got float32"):
        own.encode(
            {"image": {"side": jnp.zeros((2, 16, 16, 3))}, "state": state}, jnp.zeros(2, int)
        )
    with pytest.raises(ValueError, match="6 numbers need as many different slots"):
        own.encode({"image": {}, "state": state[:, :6]}, jnp.zeros(2, int))


def test_cameras_of_any_size_keep_their_names():
    own = processor(6)
    shades = {"wrist": ((2, 32, 32, 3), 255), "side": ((2, 8, 16, 3), 0)}
    raw = {
        "image": {
            name: jnp.full(shape, shade, jnp.uint8) for name, (shape, shade) in shades.items()
        },
        "state": jnp.zeros((2, 7)),
    }
    found = own.encode(raw, jnp.zeros(2, int)).images
    assert {name: image.shape for name, image in found.items()} == dict.fromkeys(
        shades, (2, 16, 16, 3)
    )
    np.testing.assert_allclose(found["wrist"], 1, atol=1e-6)
    np.testing.assert_allclose(found["side"], -1, atol=1e-6)
    grey = {**raw, "image": {"side": raw["image"]["side"][..., 0]}}
    with pytest.raises(ValueError, match=r"got uint8 \(2, 8, 16\)"):
        own.encode(grey, jnp.zeros(2, int))


def test_unused_slots_reach_no_motor():
    own = processor(6)
    chunk = jnp.asarray(RNG.normal(size=(2, 4, DIM)), jnp.float32)
    np.testing.assert_array_equal(own.decode(chunk), own.decode(chunk.at[..., 6].set(99.0)))
    moved = own.decode(chunk.at[..., 7].add(1.0)) - own.decode(chunk)
    assert not moved[..., :6].any()
    np.testing.assert_allclose(moved[..., 6], own.statistics.action_std[7], rtol=1e-4)


def test_pictures_are_centred_on_black():
    wide = resize_with_pad(jnp.ones((1, 8, 16, 3)), 16)[0]
    assert wide.shape == (16, 16, 3)
    assert (wide[4:12] == 1).all()
    assert (wide[:4] == -1).all()
    assert (wide[12:] == -1).all()
    small = resize_with_pad(jnp.ones((1, 20, 10, 3)), 10)[0]
    assert (small[:, 2:7] == 1).all()
    assert (small[:, :2] == -1).all()
    assert (small[:, 7:] == -1).all()


class Still:
    """A backbone that answers its own state, which makes the whole path visible."""

    def sample_actions(self, key, obs, *, num_steps, slots, return_aux):
        chunk = jnp.broadcast_to(obs.state[:, None] * slots, (2, 4, DIM))
        return chunk, {"steps": num_steps}


def test_policy_goes_from_robot_to_robot():
    own = processor(6)
    raw = {"image": {}, "state": jnp.asarray(own.statistics.state_mean[jnp.array(own.robot_slots)])}
    raw["state"] = jnp.broadcast_to(raw["state"], (2, 7))
    policy = Policy(Still(), own)
    actions, aux = policy.sample(
        jax.random.key(0), raw, jnp.zeros(2, int), num_steps=4, return_aux=True
    )
    mean = own.statistics.action_mean[jnp.array(own.robot_slots)]
    np.testing.assert_allclose(actions, jnp.broadcast_to(mean, (2, 4, 7)), atol=1e-5)
    assert aux == {"steps": 4}
