"""Test LeRobot's own recorder and replay on the fake arm, where LeRobot is installed."""

import importlib
import os
import subprocess
import sys
import warnings

import numpy as np
import pytest

from lorasp_jax.data.lerobot import LeRobot
from lorasp_jax.extras.piper.arm import PiperArm
from lorasp_jax.extras.piper.fake.firmware import FakePiper
from lorasp_jax.extras.piper.fake.timing import RealTime
from tests import ROOT
from tests.extras.piper.benches import channel

pytest.importorskip("lerobot", reason="LeRobot is not installed")
NAME = "lerobot_robot_lorasp_piper"
ROBOT = ("--robot.type=lorasp_fake_piper", "--robot.task=press", "--robot.image_size=32")
DATASET = ("--dataset.repo_id=me/press", "--play_sounds=false")
RECORDER = (
    "--teleop.type=lorasp_expert",
    "--dataset.single_task=press the button",
    "--dataset.fps=10",
    "--dataset.episode_time_s=15",
    "--dataset.num_episodes=1",
    "--dataset.streaming_encoding=true",
    "--dataset.push_to_hub=false",
)


@pytest.fixture(scope="module")
def lerobot(tmp_path_factory):
    """Return a function that runs one of LeRobot's scripts, which finds the plugin installed."""
    folder = tmp_path_factory.mktemp("lerobot")
    info = folder / f"{NAME}-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {NAME}\nVersion: 0.1.0\n")
    paths = (str(folder), str(ROOT / "examples" / "lerobot"), str(ROOT), *sys.path)
    own = {"PYTHONPATH": os.pathsep.join(paths), "HF_LEROBOT_HOME": str(folder / "home")}

    def run(script, *arguments):
        command = [sys.executable, "-m", f"lerobot.scripts.lerobot_{script}", *ROBOT, *DATASET]
        root = f"--dataset.root={folder / 'recordings'}"
        done = subprocess.run(
            [*command, root, *arguments],
            env=os.environ | own | {"HF_HUB_OFFLINE": "1"},
            capture_output=True,
            text=True,
            timeout=400,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout + done.stderr

    run.folder = folder
    return run


def test_lerobot_records_and_replays_and_we_train_on_it(lerobot):
    for seed, more in ((0, ()), (1, ("--resume=true",))):
        said = lerobot("record", f"--robot.seed={seed}", *RECORDER, *more)
        assert f"press in layout {seed} is solved" in said
    recordings = LeRobot(str(lerobot.folder / "recordings"))
    assert len(recordings.index.episodes) == 2
    episode = recordings.episode(1)
    assert episode.robot == "piper"
    assert sorted(episode.image) == ["side", "wrist"]
    assert episode.instructions == ("press the button",)
    np.testing.assert_allclose(episode.state[0, 1:, :6], episode.action[0, :-1, :6], atol=0.15)
    said = lerobot("replay", "--robot.seed=1", "--dataset.episode=1")
    assert "press in layout 1 is solved" in said
    said = lerobot("replay", "--robot.seed=1", "--dataset.episode=0")
    assert "press in layout 1 is not solved" in said  # the other layout's actions
    train = [sys.executable, str(ROOT / "train.py"), "--config", f"{ROOT}/configs/multitask.py"]
    train += ["--scale", "smoke", "--data.source", str(lerobot.folder / "recordings")]
    done = subprocess.run(
        [*train, "--optim.steps", "2", "--name", "recorded"],
        cwd=lerobot.folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (lerobot.folder / "runs" / "recorded" / "results.json").exists()


@pytest.fixture
def plugin(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(ROOT / "examples" / "lerobot")
    monkeypatch.setenv("HF_LEROBOT_HOME", str(tmp_path))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return importlib.import_module(NAME)


@pytest.mark.usefixtures("patient")
def test_the_robot_of_a_real_arm_moves_brakes_and_lets_go(plugin, world, monkeypatch, tmp_path):
    world.reset(3)
    bus = channel()
    fake = FakePiper(bus, world)
    clock = RealTime(fake)

    def arm(can, *, speed, clock):
        assert (can, speed) == ("can7", 0.5)
        arm = PiperArm(bus, bus="virtual", speed=speed, clock=clock)
        start.start(arm)
        return arm

    start = clock
    monkeypatch.setattr(plugin, "PiperArm", arm)
    config = plugin.LoraspPiperConfig(can="can7", speed=0.5, calibration_dir=tmp_path)
    robot = plugin.LoraspPiper(config)
    assert list(robot.observation_features) == list(plugin.JOINTS)
    with pytest.raises(ConnectionError):
        robot.get_observation()
    robot.connect()
    try:
        pose = robot.get_observation()
        target = pose | {"joint_1.pos": pose["joint_1.pos"] + 0.04}
        assert robot.send_action(target) == pytest.approx(target)
        clock.wait_until(clock.now() + 1.0)
        assert robot.get_observation() == pytest.approx(target, abs=0.02)
    finally:
        robot.disconnect()
        clock.stop()
        fake.close()
    assert not robot.is_connected
    assert fake.unsafe == []


def test_the_expert_needs_the_fake_arm(plugin, monkeypatch, tmp_path):
    monkeypatch.setattr(plugin, "_scene", None)
    expert = plugin.LoraspExpert(plugin.LoraspExpertConfig(calibration_dir=tmp_path))
    with pytest.raises(ConnectionError, match="lorasp_fake_piper"):
        expert.connect()
