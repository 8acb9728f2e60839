"""Exchange datasets with LeRobot itself, in an environment of its own."""

import sys

import numpy as np
import pytest

from lorasp_jax.data.lerobot import LeRobot
from lorasp_jax.data.lerobot_export import to_lerobot
from tests import ROOT, foreign
from tests.data.lerobots import golden

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]  # installs torch

SCRIPT = ROOT / "tests" / "data" / "lerobot_script.py"
# LeRobot 0.5 and later need Python 3.12.
PACKAGE = "lerobot[dataset]==0.6.1" if sys.version_info >= (3, 12) else "lerobot==0.4.4"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Datasets of LeRobot, one of this project, and what LeRobot reads from all of them."""
    folder = tmp_path_factory.mktemp("lerobot")
    to_lerobot(LeRobot(golden("v3")), folder / "ours", lambda done, total: None)
    with foreign.environment(PACKAGE) as python:
        foreign.run(python, SCRIPT, folder)
    return folder


@pytest.mark.parametrize(
    ("kind", "lengths", "tolerance"),
    [("video", [12, 7, 9], 3), ("image", [12, 7, 9], 0), ("ours", [25, 33, 40, 28], 0)],
)
def test_both_read_the_same(folder, kind, lengths, tolerance):
    dataset = LeRobot(folder / kind)
    assert (dataset.kind, dataset.num_steps) == ("LeRobot v3.0", sum(lengths))
    assert dataset.control_dt == pytest.approx(0.1)
    episodes = [dataset.episode(number) for number in range(len(dataset))]
    assert [int(episode.length[0]) for episode in episodes] == lengths
    with np.load(folder / f"{kind}.npz") as expected:
        for name, key in (("state", "observation.state"), ("action", "action")):
            found = np.concatenate([getattr(episode, name)[0] for episode in episodes])
            np.testing.assert_array_equal(found, expected[key])
            np.testing.assert_allclose(expected[f"mean/{key}"], found.mean(0), atol=1e-5)
        ends = np.repeat(np.cumsum(lengths), lengths) - 1
        rows = np.minimum(np.arange(sum(lengths))[:, None] + np.arange(3), ends[:, None])
        np.testing.assert_array_equal(expected["chunks"], found[rows])  # found: the actions
        tasks = [e.phrases[0] for e in episodes for _ in range(e.num_steps)]
        assert tasks == expected["task"].tolist()
        for camera in ("side", "wrist"):
            found = np.concatenate([episode.image[camera][0] for episode in episodes])
            wanted = np.rint(255 * expected[f"observation.images.{camera}"]).transpose(0, 2, 3, 1)
            # Decoders round colors differently; frames differ by 40 from their neighbors.
            assert np.abs(found - wanted).max() <= tolerance
            mean = expected[f"mean/observation.images.{camera}"][:, 0, 0]
            # LeRobot's own statistics are those of some of the pixels.
            atol = 1e-6 if kind == "ours" else 0.01
            np.testing.assert_allclose(mean, wanted.mean((0, 1, 2)) / 255, atol=atol)
