"""Recordings of two arms of seven dimensions each, on the input layout of published weights."""

import dataclasses
import io
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from rich.console import Console

from envs.datasets import rlds
from lorasp_jax.config import DataConfig
from lorasp_jax.data import cache
from lorasp_jax.data.keys import Keys
from lorasp_jax.data.lerobot_export import to_lerobot
from lorasp_jax.data.opening import open_source
from lorasp_jax.extras.serving.policies import describe
from lorasp_jax.extras.serving.requests import PolicySpec, parse
from lorasp_jax.models.inputs import OPENPI
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import LoRA
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training import setup
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.loop import train
from lorasp_jax.training.run_folder import read_json, read_metrics, write_json
from tests.data.lerobots import edit_info
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, leaves, random_episodes

CAMERAS = ("cam_high", "cam_low", "cam_left_wrist", "cam_right_wrist")
ARM = [*(f"joint_{i + 1}" for i in range(6)), "gripper"]
MODEL = dataclasses.replace(
    Pi0Config.dummy(),
    inputs=OPENPI,
    action_dim=Pi0Config.base().action_dim,
    cameras=Pi0Config.base().cameras,
)

NO_MEMORY = preflight.Memory(*6 * [0.0])


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """A LeRobot dataset of two arms whose dimensions have the same names."""
    folder, rng = tmp_path_factory.mktemp("two_arms"), np.random.default_rng(0)
    image = {name: rng.integers(0, 255, (3, 9, 32, 32, 3), np.uint8) for name in CAMERAS}
    state, action = rng.normal(size=(2, 3, 9, 14)).astype(np.float32)
    group = dataclasses.replace(
        random_episodes("fold", 0), image=image, state=state, action=action, robot="aloha"
    )
    rlds.write(group, folder / "rlds")
    to_lerobot(open_source(folder / "rlds"), folder / "lerobot", lambda done, total: None)
    names = {"names": {"motors": [*ARM, *ARM]}}

    def describe(info):
        for key in ("observation.state", "action"):
            info["features"][key] |= names

    edit_info(folder / "lerobot", describe)
    return folder / "lerobot", group


def prepare(folder, monkeypatch, source, cameras, *, relative=None):
    monkeypatch.setattr(preflight, "choose_remat", lambda *_: ("none", NO_MEMORY))
    monkeypatch.setattr(setup, "base_model", lambda *_, **__: (random_backbone(MODEL), ""))
    folder.mkdir(exist_ok=True)
    config = dataclasses.replace(
        CONFIG,
        data=DataConfig(source=str(source), cameras=cameras),
        model=dataclasses.replace(CONFIG.model, relative_actions=relative),
        evaluation=dataclasses.replace(CONFIG.evaluation, execute_steps=1),
        optim=dataclasses.replace(CONFIG.optim, steps=2),
        peft=LoRA(rank=4),
        targets=("action_out",),
    )
    return setup.prepare(config, folder, Console(file=io.StringIO(), width=200), time.time())


def test_they_train_and_act(recordings, tmp_path, monkeypatch):
    """With cameras chosen in the order of the backbone's; a fourth is named and left out."""
    source, group = recordings
    cameras = ("cam_high", "cam_right_wrist", "cam_left_wrist")
    run = prepare(tmp_path, monkeypatch, source, cameras)
    printed = run.console.file.getvalue()
    assert "left out: cam_low (not chosen)" in printed
    processor = run.policy.processor
    assert processor.cameras == tuple(zip(MODEL.cameras, cameras, strict=True))
    assert processor.state_slots == tuple(range(14))
    run.devices = jax.devices()[:1]
    before = leaves(nnx.state(run.policy.model))
    train(run)
    after = leaves(nnx.state(run.policy.model))
    assert any((after[name] != array).any() for name, array in before.items())
    raw = {
        "image": {name: jnp.asarray(group.image[name][:, 0]) for name in cameras},
        "state": jnp.asarray(group.state[:, 0]),
    }
    actions = jax.jit(Policy.sample)(run.policy, jax.random.key(0), raw, jnp.zeros(3, int))
    assert actions.shape == (3, MODEL.chunk, 14)
    assert np.isfinite(actions).all()
    needs = describe(run.policy, num_steps=1, batch_sizes=(1,), continues=False, metadata={})
    spec = PolicySpec(needs.cameras, needs.image_size, needs.state_dim, needs.chunk)
    pictures = {name: group.image[name][0, 0] for name in CAMERAS}
    request = parse({"state": group.state[0, 0], "images": pictures, "prompt": "fold"}, spec)
    assert (request.actions, request.state.shape) == (14, (14,))


def test_more_cameras_than_the_backbone_accepts_must_be_chosen(recordings, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"cam_high, .* at most 3: choose with --data\.cameras"):
        prepare(tmp_path, monkeypatch, recordings[0], ())
    with pytest.raises(ValueError, match=r"no camera 'top': choose from cam_high, cam_low"):
        prepare(tmp_path, monkeypatch, recordings[0], ("cam_high", "top"))


def test_fewer_cameras_are_masked(recordings, tmp_path, monkeypatch):
    source, group = recordings
    run = prepare(tmp_path, monkeypatch, source, ("cam_low",))
    raw = {"image": {"cam_low": group.image["cam_low"][:, 0]}, "state": group.state[:, 0]}
    encoded = run.policy.processor.encode(raw, jnp.zeros(3, int))
    assert [bool(mask.all()) for mask in encoded.image_masks.values()] == [True, False, False]
    run.devices = jax.devices()[:1]
    train(run)
    assert read_metrics(run.folder)[-1]["step"] == 2


def test_relative_actions_spare_both_grippers(recordings, tmp_path, monkeypatch):
    """Through the cache of a run, one that was converted, and one of an older version."""
    source, group = recordings
    mask = (*[True] * 6, False) * 2
    run = prepare(tmp_path / "run", monkeypatch, source, ("cam_high",), relative=True)
    assert run.policy.processor.inputs.delta == mask
    state, chunk = jnp.asarray(group.state[:, 0]), jnp.asarray(group.action[:, : MODEL.chunk])
    shifted = run.policy.processor.normalize_actions(chunk + 1, state + 1)
    same = run.policy.processor.normalize_actions(chunk, state)
    moved = np.abs(shifted - same)[:, 0, :14] > 1e-4
    np.testing.assert_array_equal(moved, [~np.array(mask)] * 3)
    assert run.recordings is not None
    assert run.recordings.grippers == {"state": [6, 13], "action": [6, 13]}
    left_first = Keys(grippers=("6", "12"), cameras={"cam_high": "observation.images.cam_high"})
    cache.write([open_source(source, left_first)], tmp_path / "mine", lambda *_: None)
    chosen = prepare(tmp_path / "other", monkeypatch, tmp_path / "mine", (), relative=True)
    assert np.flatnonzero(~np.array(chosen.policy.processor.inputs.delta)).tolist() == [6, 12]
    header = read_json(tmp_path / "mine" / cache.HEADER)
    for name in ("names", "grippers"):
        del header[name]
    write_json(tmp_path / "mine" / cache.HEADER, header)
    older = prepare(tmp_path / "older", monkeypatch, tmp_path / "mine", (), relative=True)
    assert np.flatnonzero(~np.array(older.policy.processor.inputs.delta)).tolist() == [13]
    write_json(
        tmp_path / "mine" / cache.HEADER, header | {"grippers": {"state": [], "action": [14]}}
    )
    with pytest.raises(ValueError, match="grippers of action must be those of 14 numbers"):
        open_source(tmp_path / "mine")
