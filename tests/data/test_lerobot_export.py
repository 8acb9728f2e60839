"""Export to LeRobot v3.0, read back by this project; `test_lerobot_itself` has LeRobot's reader."""

import dataclasses
import json

import numpy as np
import pyarrow.parquet as pq
import pytest

from envs.datasets import rlds
from lorasp_jax.data.lerobot import LeRobot
from lorasp_jax.data.lerobot_export import to_lerobot
from lorasp_jax.data.opening import open_source
from tests.cases import mostly_slow
from tests.data.lerobots import VERSIONS, golden
from tests.envs.datasets.test_episodes import assert_equal, make


def silent(done, total):
    pass


@pytest.fixture(scope="module", params=mostly_slow(VERSIONS, ["v3"]))
def exported(request, tmp_path_factory):
    """The episodes of a source, the folder of its export, and the reports of progress."""
    source, reports = LeRobot(golden(request.param)), []
    folder = tmp_path_factory.mktemp("exported") / "dataset"
    to_lerobot(source, folder, lambda *done: reports.append(done))
    return [source.episode(number) for number in range(4)], folder, reports


def test_episodes_are_equal(exported):
    episodes, folder, reports = exported
    assert reports == [(25, 126), (58, 126), (98, 126), (126, 126)]
    found = LeRobot(folder)
    assert (found.kind, len(found)) == ("LeRobot v3.0", 4)
    assert found.names == LeRobot(golden("v3")).names
    for number, episode in enumerate(episodes):
        assert_equal(found.episode(number), episode)


def test_statistics_are_those_of_all_steps(exported):
    episodes, folder, _ = exported
    stats = json.loads((folder / "meta" / "stats.json").read_text())
    state = np.concatenate([episode.state[0] for episode in episodes]).astype(np.float64)
    pixels = np.concatenate([e.image["wrist"].reshape(-1, 3) for e in episodes]) / 255
    for name, rows, shape in (
        ("observation.state", state, (7,)),
        ("observation.images.wrist", pixels, (3, 1, 1)),
    ):
        for statistic in ("min", "max", "mean", "std"):
            expected = getattr(np, statistic)(rows, axis=0).reshape(shape)
            np.testing.assert_allclose(stats[name][statistic], expected, rtol=1e-6, atol=1e-9)
        assert stats[name]["count"] == [126]


def test_actions_other_than_joint_targets(tmp_path):
    episodes = make(actions="end_effector", robot="panda", control_dt=0.05)
    rlds.write(episodes, tmp_path / "episodes")
    to_lerobot(open_source(tmp_path / "episodes"), tmp_path / "dataset", silent)
    info = json.loads((tmp_path / "dataset" / "meta" / "info.json").read_text())
    assert (info["fps"], info["robot_type"]) == (20, "panda")
    assert info["features"]["action"]["names"] is None
    assert info["features"]["observation.state"]["names"][-2:] == ["joint_6.pos", "gripper.pos"]
    rows = pq.read_table(tmp_path / "dataset" / "data" / "chunk-000" / "file-001.parquet")
    length = int(episodes.length[1])
    np.testing.assert_array_equal(rows["action"].to_pylist(), episodes.action[1, :length])
    np.testing.assert_array_equal(rows["index"], int(episodes.length[0]) + np.arange(length))


def test_fewer_actions_than_states(tmp_path):
    """As for LIBERO, whose state has two fingers and whose actions have one gripper."""
    episodes = make(actions="end_effector", robot="panda", control_dt=0.05)
    state = np.concatenate([episodes.state, -episodes.state[..., -1:]], -1)
    rlds.write(dataclasses.replace(episodes, state=state), tmp_path / "episodes")
    to_lerobot(open_source(tmp_path / "episodes"), tmp_path / "dataset", silent)
    found = LeRobot(tmp_path / "dataset").episode(1)
    length = int(episodes.length[1])
    np.testing.assert_array_equal(found.state[0], state[1, :length])
    np.testing.assert_array_equal(found.action[0], episodes.action[1, :length])


def test_refusals_leave_nothing(tmp_path):
    source = LeRobot(golden("v3"))
    source.control_dt = 0.03
    with pytest.raises(ValueError, match=r"33\.3"):
        to_lerobot(source, tmp_path / "dataset", silent)
    source, first = LeRobot(golden("v3")), LeRobot(golden("v3")).episode(0)
    source.episode = lambda number, *_: dataclasses.replace(first, robot=f"arm_{number}")
    with pytest.raises(ValueError, match="episode 1"):
        to_lerobot(source, tmp_path / "dataset", silent)
    assert not list(tmp_path.iterdir())
