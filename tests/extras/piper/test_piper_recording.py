"""Recording episodes: of a policy, of a hand, of a leader; the dataset feeds training."""

import json
from unittest.mock import patch

import can
import numpy as np
import pytest

from envs.datasets.rlds import read
from envs.robots.piper import SDK_OFFSET
from lorasp_jax.data.opening import open_source
from lorasp_jax.extras.piper.asking import InTurn
from lorasp_jax.extras.piper.fake import frames
from lorasp_jax.extras.piper.fake.demonstrator import Demonstrator
from lorasp_jax.extras.piper.recording import Recording
from lorasp_jax.extras.piper.safety import Unsafe
from lorasp_jax.extras.piper.session import Session
from lorasp_jax.extras.piper.settings import Settings
from lorasp_jax.extras.piper.teaching import Lesson

WAYS = {"task": "press", "instructions": ("press it", "push it"), "control_dt": 0.1}


def recording(folder, prompt="push it", **more):
    return Recording(folder, prompt=prompt, image_size=16, **{**WAYS, **more})


def lesson(bench, recorder, way):
    look = bench.world.images
    return Lesson(bench.arms, look, recorder, bench.clock, way=way, control_dt=0.1)


def only_episode(folder):
    source = open_source(folder)
    assert len(source) == 1
    return source.episode(0)


def test_a_policys_episode_is_recorded_as_it_was_executed(bench, tmp_path):
    recorder = recording(tmp_path / "data")
    expert = Demonstrator(bench.world, bench.clock, seed=0)
    look, asker = bench.world.images, InTurn(expert, bench.clock)
    settings = Settings("push it")
    session = Session(
        bench.arms, look, asker, settings, bench.clock, recorder=recorder, say=pytest.fail
    )
    assert session.run(2.0) is None
    assert recorder.steps == 20
    recorder.keep()
    episode = only_episode(tmp_path / "data")
    assert episode.num_steps == 20
    assert episode.phrases[0] == "push it"
    assert (episode.robot, episode.control_dt, episode.physics_dt) == ("piper", 0.1, 0.0)
    assert sorted(episode.image) == ["side", "wrist"]
    assert episode.image["wrist"].shape == (1, 20, 16, 16, 3)
    np.testing.assert_allclose(episode.action[0], expert.actions[:20], atol=1e-6)
    np.testing.assert_allclose(episode.state[0, 1:], episode.action[0, :-1], atol=0.06)


def test_guiding_by_hand_is_recorded(bench, tmp_path):
    recorder = recording(tmp_path / "data")
    start = bench.world.pose
    begin = bench.clock.now()

    def hand():
        turn = 0.2 * max(0.0, bench.clock.now() - begin - 0.3)  # nothing moves for 0.3 s
        bench.fake.hand = start + np.array([turn, 0, 0, 0, 0, 0, 0])

    teacher = lesson(bench, recorder, "hand")
    teacher.run(1.5, done=hand)
    assert 9 <= recorder.steps <= 12
    recorder.keep()
    episode = only_episode(tmp_path / "data")
    np.testing.assert_allclose(episode.state[0, 1:], episode.action[0, :-1], atol=1e-6)
    assert np.ptp(episode.state[0, :, 0]) > 0.1
    bench.wait(0.05)
    assert bench.arm.read().ctrl_mode == 0  # teaching has ended
    assert bench.fake.unsafe == []


def test_a_leaders_targets_are_the_actions(bench, tmp_path):
    recorder = recording(tmp_path / "data")
    leader = can.Bus(bench.fake._bus.channel_id, interface="virtual", preserve_timestamps=True)
    target = bench.world.pose

    def send(kind, data):
        leader.send(
            can.Message(
                arbitration_id=kind, data=data, is_extended_id=False, timestamp=bench.clock.now()
            )
        )

    def lead():
        target[0] += 0.02
        counts = np.rad2deg(target[:6] - SDK_OFFSET) * 1000
        send(frames.MODE, bytes([1, 1, 100, 0, 0, 0, 0, 0]))
        for i, kind in enumerate(frames.TARGETS):
            send(kind, frames.pair(*counts[2 * i : 2 * i + 2]))
        send(frames.GRIPPER_TARGET, frames.gripper(target[6] * 1e6, 1000, True)[:6] + b"\1\0")
        bench.wait(0.005)

    teacher = lesson(bench, recorder, "leader")
    teacher.run(1.0, done=lead)
    recorder.keep()
    action = only_episode(tmp_path / "data").action[0]
    np.testing.assert_allclose(np.diff(action[:, 0]), 0.02, atol=1e-4)
    leader.shutdown()


def test_a_lesson_that_was_stopped_before_it_began_leaves_the_arm_alone(bench, tmp_path):
    teacher = lesson(bench, recording(tmp_path / "data"), "hand")
    teacher.stop()
    with patch.object(bench.arms, "teach") as teach:
        teacher.run(1.0)
    assert not teach.called


def test_a_lesson_without_a_leader_is_refused(bench, tmp_path):
    bench.wait(0.06)
    with pytest.raises(Unsafe, match="no leader sends targets"):
        lesson(bench, recording(tmp_path / "data"), "leader").run(1.0)


def test_a_lesson_ends_when_the_arm_fails_and_leaves_teaching_mode(bench, tmp_path):
    bench.fake.faults.status = 8
    bench.wait(0.01)
    with pytest.raises(Unsafe, match="too fast while guided by hand"):
        lesson(bench, recording(tmp_path / "data"), "hand").run(1.0)
    bench.wait(0.05)
    assert bench.fake._ctrl_mode == 0


def filled(recorder, steps=3):
    for i in range(steps):
        image = np.full((24, 32, 3), i, np.uint8)
        recorder.step({"side": image, "wrist": image}, np.full(7, 0.1), np.full(7, 0.2))
    return recorder


def test_a_dataset_grows_over_several_runs_and_keeps_only_what_it_is_told(tmp_path):
    filled(recording(tmp_path / "data")).keep()
    recorder = filled(recording(tmp_path / "data", "press it"), 5)
    assert recorder.num_episodes == 1
    recorder.discard()
    filled(recorder, 4).keep()
    source = open_source(tmp_path / "data")
    assert [source.episode(i).num_steps for i in range(len(source))] == [3, 4]
    assert int(source.episode(1).instruction[0]) == 0
    image = source.episode(0).image["side"]
    assert image.shape[2:] == (16, 16, 3)  # padded to a square


def test_other_settings_or_nothing_are_refused(tmp_path):
    filled(recording(tmp_path / "data")).keep()
    with pytest.raises(ValueError, match="image_size"):
        Recording(tmp_path / "data", prompt="press it", image_size=32, **WAYS)
    for name, other in (("control_dt", 0.2), ("task", "pour")):  # before anything is demonstrated
        with pytest.raises(ValueError, match=f"data has {name} .* choose another folder"):
            recording(tmp_path / "data", **{name: other})
    with pytest.raises(ValueError, match="no step"):
        recording(tmp_path / "data").keep()
    assert len(open_source(tmp_path / "data")) == 1


def test_an_older_dataset_cannot_mark_corrections(tmp_path):
    filled(recording(tmp_path / "data")).keep(success=True)
    assert recording(tmp_path / "data").marks
    metadata = tmp_path / "data" / "metadata.json"
    content = json.loads(metadata.read_text())
    assert content.pop("corrected")
    metadata.write_text(json.dumps(content))
    assert not recording(tmp_path / "data").marks


def test_a_new_phrasing_is_added(tmp_path):
    filled(recording(tmp_path / "data", "tap it")).keep()
    episode = only_episode(tmp_path / "data")
    assert episode.instructions == ("press it", "push it", "tap it")
    assert int(episode.instruction[0]) == 2


def test_a_dataset_takes_new_phrasings_in_later_sessions(tmp_path):
    filled(recording(tmp_path / "data", "tap it")).keep()
    filled(recording(tmp_path / "data", "hit it", task="", instructions=())).keep()
    filled(recording(tmp_path / "data", "press it")).keep()
    source = open_source(tmp_path / "data")
    episodes = [source.episode(i) for i in range(len(source))]
    said = [e.phrases[0] for e in episodes]
    assert said == ["tap it", "hit it", "press it"]
    assert episodes[0].instructions == ("press it", "push it", "tap it", "hit it")
    read(tmp_path / "data").validate()
