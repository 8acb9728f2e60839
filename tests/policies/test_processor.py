"""Encoding observations and decoding actions, for our own and for published weights."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.models.inputs import OPENPI
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig
from lorasp_jax.policies import prompts
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor, robot_slots, to_absolute, to_delta
from lorasp_jax.policies.prompt_table import Ids, PromptTable
from lorasp_jax.policies.statistics import Statistics
from lorasp_jax.policies.tokenizer import Offline

DIM = 8
RNG = np.random.default_rng(0)
encode, decode, normalize = map(
    jax.jit, (Processor.encode, Processor.decode, Processor.normalize_actions)
)
ROBOTS = {"piper": ((0, 1, 2, 3, 4, 5, 7), 6), "panda": ((0, 1, 2, 3, 4, 5, 6, 7), 7)}


def processor(num_joints: int) -> Processor:
    slots = robot_slots(num_joints)
    state = RNG.normal(2.0, 3.0, (4, 5, len(slots)))
    action = RNG.normal(-1.0, 0.5, (4, 5, len(slots)))
    valid = np.ones((4, 5), bool)
    statistics = Statistics.measure(state, action, valid, slots=slots, dim=DIM)
    tokens = jnp.array([[3, 4, 0], [5, 0, 0]])
    return Processor(slots, slots, statistics, PromptTable(Ids(tokens, tokens > 0)), image_size=16)


@pytest.mark.parametrize("robot", ROBOTS)
def test_slots(robot):
    slots, joints = ROBOTS[robot]
    assert robot_slots(joints) == slots
    assert np.flatnonzero(processor(joints).flow_slots).tolist() == list(slots)
    with pytest.raises(ValueError, match=r"num_joints .* got 8"):
        robot_slots(8)


@pytest.mark.parametrize("robot", ROBOTS)
def test_decode_inverts_normalize(robot):
    proc = processor(ROBOTS[robot][1])
    actions = RNG.normal(size=(3, 4, len(proc.action_slots))).astype(np.float32)
    normalized = np.asarray(normalize(proc, actions))
    assert normalized.shape == (3, 4, DIM)
    assert not normalized[..., ~proc.flow_slots].any()
    np.testing.assert_allclose(decode(proc, normalized), actions, atol=1e-5)


def test_encode():
    proc = processor(6)
    image = RNG.integers(0, 256, (2, 16, 16, 3), np.uint8)
    state = RNG.normal(size=(2, 7)).astype(np.float32)
    raw = {"image": {"side": jnp.asarray(image)}, "state": jnp.asarray(state)}
    obs = jax.device_get(encode(proc, raw, np.array([1, 0])))
    np.testing.assert_allclose(obs.images["side"], image / 127.5 - 1, atol=1e-6)
    assert obs.tokens.tolist() == [[5, 0, 0], [3, 4, 0]]
    assert obs.token_mask.sum(axis=1).tolist() == [1, 2]
    assert obs.image_masks["side"].all()
    assert not obs.state[:, 6].any()
    gripper = (state[:, -1] - proc.statistics.state["mean"][7]) / proc.statistics.state["std"][7]
    np.testing.assert_allclose(obs.state[:, 7], gripper, rtol=1e-5)


def test_invalid_observations_raise():
    proc = processor(6)
    state = np.zeros((2, 7), np.float32)
    with pytest.raises(ValueError, match=r"'side' .* got float32"):
        encode(
            proc, {"image": {"side": np.zeros((2, 16, 16, 3))}, "state": state}, np.zeros(2, int)
        )
    with pytest.raises(ValueError, match="slots"):
        encode(proc, {"image": {}, "state": state[:, :6]}, np.zeros(2, int))


def test_images_are_resized_under_their_names():
    proc = processor(6)
    shades = {"wrist": ((2, 32, 32, 3), 255), "side": ((2, 8, 16, 3), 0)}
    raw = {
        "image": {name: np.full(shape, shade, np.uint8) for name, (shape, shade) in shades.items()},
        "state": np.zeros((2, 7), np.float32),
    }
    images = encode(proc, raw, np.zeros(2, int)).images
    assert {name: image.shape for name, image in images.items()} == dict.fromkeys(
        shades, (2, 16, 16, 3)
    )
    np.testing.assert_allclose(images["wrist"], 1, atol=1e-6)
    np.testing.assert_allclose(images["side"], -1, atol=1e-6)
    gray = {**raw, "image": {"side": raw["image"]["side"][..., 0]}}
    with pytest.raises(ValueError, match=r"got uint8 \(2, 8, 16\)"):
        encode(proc, gray, np.zeros(2, int))


def test_unused_slots_do_not_affect_actions():
    proc = processor(6)
    chunk, slots = RNG.normal(size=(2, 4, DIM)).astype(np.float32), np.arange(DIM)
    actions = np.asarray(decode(proc, chunk))
    np.testing.assert_array_equal(actions, decode(proc, np.where(slots == 6, 99, chunk)))
    moved = decode(proc, chunk + (slots == 7)) - actions
    assert not moved[..., :6].any()
    np.testing.assert_allclose(moved[..., 6], proc.statistics.action["std"][7], rtol=1e-4)


def published(num_joints: int = 6, relative: tuple[bool, ...] = (), **choices) -> Processor:
    """Processor with openpi's inputs: contiguous slots, noise in all 32 slots."""
    inputs = dataclasses.replace(OPENPI, delta=relative)
    config = dataclasses.replace(Pi0Config.base(), image_size=28, inputs=inputs)
    state, action = RNG.normal(2.0, 3.0, (2, 20, num_joints + 1))
    valid = np.ones(20, bool)
    statistics = Statistics.measure(
        state, action, valid, slots=range(num_joints + 1), dim=num_joints + 1
    )
    ids = jnp.array([[3, 4, 0]])
    prompts = PromptTable(Ids(ids, ids > 0))
    return Processor.of(config, statistics, prompts, num_joints=num_joints, **choices)


def test_published_weights_use_contiguous_slots():
    proc = published()
    assert proc.state_slots == proc.action_slots == (0, 1, 2, 3, 4, 5, 6)
    assert proc.flow_slots.sum() == 32
    state = RNG.normal(size=(2, 7)).astype(np.float32)
    obs = jax.device_get(encode(proc, {"image": {}, "state": jnp.asarray(state)}, np.zeros(2, int)))
    mean, std = proc.statistics.state["mean"][:7], proc.statistics.state["std"][:7]
    np.testing.assert_allclose(obs.state[:, :7], (state - mean) / (std + 1e-6), rtol=1e-5)
    assert not obs.state[:, 7:].any()
    actions = RNG.normal(size=(2, 4, 7)).astype(np.float32)
    np.testing.assert_allclose(decode(proc, normalize(proc, actions)), actions, atol=1e-5)


def test_missing_cameras_are_black_and_masked():
    """The robot has two cameras for pi0's three."""
    proc = published(cameras={"base_0_rgb": "side", "left_wrist_0_rgb": "wrist"})
    raw = {
        "image": {
            "wrist": np.full((2, 14, 28, 3), 255, np.uint8),
            "side": np.full((2, 28, 28, 3), 0, np.uint8),
        },
        "state": np.zeros((2, 7), np.float32),
    }
    obs = jax.device_get(encode(proc, raw, np.zeros(2, int)))
    assert list(obs.images) == list(Pi0Config.base().cameras)
    assert {name: mask.tolist() for name, mask in obs.image_masks.items()} == {
        "base_0_rgb": [True, True],
        "left_wrist_0_rgb": [True, True],
        "right_wrist_0_rgb": [False, False],
    }
    wrist = obs.images["left_wrist_0_rgb"]
    np.testing.assert_allclose(wrist[:, 7:21], 1, atol=1e-6)
    assert (wrist[:, :7] == -1).all()
    assert obs.images["right_wrist_0_rgb"].shape == (2, 28, 28, 3)
    assert (obs.images["right_wrist_0_rgb"] == -1).all()
    with pytest.raises(ValueError, match="wrist"):
        encode(proc, {**raw, "image": {"side": raw["image"]["side"]}}, np.zeros(2, int))
    with pytest.raises(ValueError, match=r"base_0_rgb.*'top'"):
        published(cameras={"top": "side"})


def test_smolvla_is_padded_at_the_top():
    config = dataclasses.replace(SmolVLAConfig.base(), image_size=64)
    proc = processor(6)
    proc = dataclasses.replace(proc, image_size=64, inputs=config.inputs)
    proc = dataclasses.replace(proc, state_slots=robot_slots(6, config.inputs))
    raw = {
        "image": {"side": np.full((1, 32, 64, 3), 255, np.uint8)},
        "state": np.zeros((1, 7), np.float32),
    }
    image = np.asarray(encode(proc, raw, np.zeros(1, int)).images["side"])[0]
    np.testing.assert_allclose(image[32:], 1, atol=1e-6)
    assert (image[:32] == -1).all()


def test_delta_actions():
    """Joints are relative to the state, the gripper is not; values computed by hand."""
    state = np.array([[1.0, 2.0, 3.0]], np.float32)
    actions = np.array([[[1.5, 2.0, 0.1], [0.0, 5.0, 0.2]]], np.float32)
    delta = to_delta(actions, state, (True, True, False))
    np.testing.assert_allclose(delta, [[[0.5, 0.0, 0.1], [-1.0, 3.0, 0.2]]], atol=1e-6)
    np.testing.assert_allclose(to_delta(actions, state, (True,))[0, 1], [-1.0, 5.0, 0.2])
    np.testing.assert_allclose(to_absolute(delta, state, (True, True, False)), actions, atol=1e-6)


def test_delta_actions_are_decoded_as_absolute():
    mask = (*[True] * 6, False)
    proc, absolute = published(relative=mask), published()
    proc = dataclasses.replace(proc, statistics=absolute.statistics)
    state = RNG.normal(size=(2, 7)).astype(np.float32)
    actions = RNG.normal(size=(2, 4, 7)).astype(np.float32)
    relative = actions - state[:, None] * np.array(mask)
    normalized = normalize(proc, actions, state)
    np.testing.assert_allclose(normalized, normalize(absolute, relative), atol=1e-5)
    np.testing.assert_allclose(decode(proc, normalized, state), actions, atol=1e-5)
    with pytest.raises(ValueError, match="pass the raw state"):
        decode(proc, normalized)
    with pytest.raises(ValueError, match="delta mask has 14"):
        published(relative=(True,) * 14)


def test_a_previous_chunk_is_made_relative_to_the_current_state():
    """Real-time chunking: what the robot is executing stays the same in absolute joint targets."""
    options = {}

    class Recorder:
        def sample_actions(self, key, obs, **given):
            options.update(given)
            return given["prefix"], {}

    proc = processor(6)
    relative = dataclasses.replace(proc.inputs, delta=(*[True] * 6, False))
    policy = Policy(Recorder(), dataclasses.replace(proc, inputs=relative))
    previous = RNG.normal(size=(2, 3, 7)).astype(np.float32)

    @jax.jit
    def sample(raw):
        return policy.sample(
            None, raw, np.zeros(2, int), previous=previous, prefix_length=2
        ), options["prefix"]

    raw = {"image": {}, "state": np.arange(14, dtype="f").reshape(2, 7)}
    chunk, prefix = sample(raw)
    np.testing.assert_allclose(chunk, previous, atol=1e-5)
    absolute = normalize(proc, previous)
    assert prefix.shape == absolute.shape == (2, 3, 8)
    assert np.abs(prefix - absolute)[..., :6].max() > 1
    assert (options["prefix_length"], options["guidance"]) == (2, None)


def test_prompts_contain_the_normalized_state(few_bins):
    """The state is that of the robot's slots, with the added noise."""
    config, texts = Pi0Config.nano_pi05(), ["press the button", "push it"]
    state, action = RNG.normal(2.0, 3.0, (2, 50, 7))
    valid = np.ones(50, bool)
    statistics = Statistics.measure(state, action, valid, slots=range(7), dim=7)
    table = PromptTable.of(Offline(), texts, config, num_joints=6)
    proc = Processor.of(config, statistics, table, num_joints=6)
    raw = {"image": {}, "state": state.astype(np.float32)}
    noise = RNG.normal(size=(50, DIM)).astype(np.float32)
    rows = RNG.integers(0, 2, 50)
    obs = jax.device_get(encode(proc, raw, rows, state_noise=noise))
    low, high = np.quantile(state, [0.01, 0.99], axis=0)
    normalized = 2 * (state - low) / (high - low) - 1 + noise[:, [0, 1, 2, 3, 4, 5, 7]]
    np.testing.assert_allclose(obs.state[:, [0, 1, 2, 3, 4, 5, 7]], normalized, atol=1e-5)
    normalized = obs.state[:, [0, 1, 2, 3, 4, 5, 7]]
    expected = [
        prompts.pi05(texts[row], values) for row, values in zip(rows, normalized, strict=True)
    ]
    ids, mask = Offline().encode(expected, config.max_tokens, complete=True)
    np.testing.assert_array_equal(obs.tokens, ids)
    np.testing.assert_array_equal(obs.token_mask, mask)


class EchoBackbone:
    """A backbone that returns its own state."""

    def sample_actions(self, key, obs, *, num_steps, slots, return_aux):
        chunk = jnp.broadcast_to(obs.state[:, None] * slots, (2, 4, DIM))
        return chunk, {"steps": num_steps}


def test_policy_encodes_and_decodes():
    proc = processor(6)
    state, action = (
        np.broadcast_to(np.asarray(stats["mean"])[[*proc.state_slots]], (2, 7))
        for stats in (proc.statistics.state, proc.statistics.action)
    )
    policy = Policy(EchoBackbone(), proc)
    actions, aux = jax.jit(
        lambda raw: policy.sample(None, raw, np.zeros(2, int), num_steps=4, return_aux=True)
    )({"image": {}, "state": state})
    np.testing.assert_allclose(actions, np.stack([action] * 4, 1), atol=1e-5)
    assert aux == {"steps": 4}


def test_actions_may_be_shorter_than_states():
    """LIBERO has eight numbers of state and seven of action; six are relative."""
    six, eight = (
        dataclasses.replace(Pi0Config.base(), inputs=dataclasses.replace(OPENPI, delta=n * (True,)))
        for n in (6, 8)
    )
    state, action = RNG.normal(size=(20, 8)), RNG.normal(2.0, 3.0, (20, 7))
    measured = Statistics.measure(
        state, action, np.ones(20, bool), slots=range(8), dim=32, action_slots=range(7)
    )
    ids = jnp.array([[3, 4, 0]])
    prompts = PromptTable(Ids(ids, ids > 0))
    proc = Processor.of(six, measured, prompts, num_joints=7, action_length=7)
    assert (len(proc.state_slots), len(proc.action_slots)) == (8, 7)
    zeros = np.zeros((1, 2, 32), np.float32)
    decoded = np.asarray(decode(proc, zeros, state[:1].astype(np.float32)))[0, 1]
    np.testing.assert_allclose(decoded[:6], state[0, :6] + action.mean(axis=0)[:6], rtol=1e-4)
    np.testing.assert_allclose(decoded[6], action[:, 6].mean(), rtol=1e-4)
    back = normalize(proc, decoded[None, None], state[:1].astype(np.float32))
    np.testing.assert_allclose(back, zeros[:, :1], atol=1e-5)
    with pytest.raises(ValueError, match="delta mask has 8"):
        Processor.of(eight, measured, prompts, num_joints=7, action_length=7)
