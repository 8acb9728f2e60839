"""Read invalid RLDS datasets, and only parts of valid ones."""

import dataclasses

import numpy as np
import pytest
from array_record.python import array_record_module

from envs.datasets import rlds, rlds_schema
from tests.envs.datasets.test_episodes import assert_equal, make


@pytest.fixture
def path(tmp_path):
    rlds.write(make(), tmp_path / "press")
    return tmp_path / "press"


def rewrite(path, episodes):
    """Replace a dataset's records by ones that `rlds.write` would refuse."""
    to = rlds_schema.serializer(rlds_schema.features(rlds.metadata(path)))
    (file,) = path.glob("*array_record*")
    writer = array_record_module.ArrayRecordWriter(str(file), "group_size:1,uncompressed")
    for number in range(episodes.num_episodes):
        writer.write(rlds_schema.record(to, episodes, number, number))
    writer.close()


def content(path):
    return {file.name: file.read_bytes() for file in path.iterdir()}


def test_one_episode_at_a_time(path):
    found, wanted = rlds.Reader(path), make()
    assert (len(found), found.num_steps, found.control_dt, found.kind) == (3, 6, 0.1, "RLDS")
    for number in (2, 0):
        length = int(wanted.length[number])
        one = wanted.select([number])
        short = dataclasses.replace(
            one,
            image={name: picture[:, :length] for name, picture in one.image.items()},
            state=one.state[:, :length],
            action=one.action[:, :length],
            attempted=1,
        )
        assert_equal(found.episode(number), short)
        assert_equal(found.episode(number, ()), dataclasses.replace(short, image={}))
        (camera,) = found.episode(number, ["wrist"]).image
        assert camera == "wrist"


def test_values_that_are_not_finite(path):
    episodes = make()
    episodes.state[1, 0, 2] = np.nan
    rewrite(path, episodes)
    before = content(path)
    with pytest.raises(ValueError, match=r"press is damaged .*state .* dimension 2"):
        rlds.read(path)
    assert content(path) == before


def test_an_empty_episode(path):
    one = make()
    nothing = {name: picture[:, :0] for name, picture in one.image.items()}
    rewrite(path, dataclasses.replace(one, image=nothing, length=np.array([1, 0, 1], np.int32)))
    with pytest.raises(ValueError, match="press is damaged"):
        rlds.read(path)
