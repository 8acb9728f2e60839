"""Exchange datasets with tensorflow-datasets itself, in an environment of its own."""

import numpy as np
import pytest

from envs.datasets import rlds
from tests import ROOT, foreign
from tests.envs.datasets.test_episodes import assert_equal, make
from tests.envs.datasets.test_rlds import trimmed

pytestmark = pytest.mark.slow

SCRIPT = ROOT / "tests" / "envs" / "datasets" / "tfds_script.py"
# tfds does not declare importlib_resources.
PACKAGES = ("tensorflow-datasets==4.9.10", "array-record", "importlib_resources", "pillow")
EPISODES = make(3, 5, length=np.array([2, 4, 5], np.int32))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A dataset of this project, a copy written by tfds, and what tfds reads."""
    folder = tmp_path_factory.mktemp("tfds")
    rlds.write(EPISODES, folder / "ours")
    with foreign.environment(*PACKAGES) as python:
        foreign.run(python, SCRIPT, folder / "ours", folder / "theirs", folder / "arrays.npz")
    return folder


def test_tfds_reads_every_value(folder):
    with np.load(folder / "arrays.npz") as found:
        for number, length in enumerate(EPISODES.length):
            for name, array in (
                ("image", EPISODES.image["side"]),
                ("wrist_image", EPISODES.image["wrist"]),
                ("state", EPISODES.state),
                ("action", EPISODES.action),
            ):
                expected = array[number, :length]
                np.testing.assert_array_equal(found[f"{number}/{name}"], expected)
            text = EPISODES.instructions[EPISODES.instruction[number]].encode()
            assert found[f"{number}/text"].tolist() == [text] * int(length)


def test_a_copy_that_tfds_wrote_is_read(folder):
    (copy,) = (folder / "theirs").glob("*/2.0.0")
    assert (copy / "press-train.array_record-00000-of-00001").is_file()
    assert_equal(rlds.read(copy), trimmed(EPISODES))
