"""Where collections end up: nothing is lost by a kill."""

import os
import shutil

import pytest

from envs.datasets import places, rlds
from tests.envs.datasets.test_episodes import make


@pytest.fixture
def path(tmp_path):
    return tmp_path / "new folder" / "press"


def test_only_datasets_are_replaced(tmp_path, path):
    rlds.write(make(2), path)
    rlds.write(make(3), tmp_path / "better")
    (tmp_path / "photos").mkdir()
    with pytest.raises(ValueError, match="photos is not a folder of envs-rlds-1 episodes"):
        places.install(tmp_path / "better", tmp_path / "photos")
    places.install(tmp_path / "better", path)
    assert rlds.read(path).num_episodes == 3
    assert os.listdir(path.parent) == ["press"]


@pytest.mark.parametrize(("owner", "name"), [(os, "rename"), (shutil, "rmtree")])
def test_a_kill_while_a_dataset_is_replaced(tmp_path, path, monkeypatch, owner, name):
    rlds.write(make(2), path)
    rlds.write(make(3), tmp_path / "better")
    function = getattr(owner, name)

    def killed(*arguments):
        if name == "rmtree" or arguments[0] == tmp_path / "better":
            raise KeyboardInterrupt
        function(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, killed)
        with pytest.raises(KeyboardInterrupt):
            places.install(tmp_path / "better", path)
    assert len(os.listdir(path.parent)) == (2 if name == "rmtree" else 1)
    places.recover(path)
    assert os.listdir(path.parent) == ["press"]
    assert rlds.read(path).num_episodes == (3 if name == "rmtree" else 2)
    places.recover(path)  # does nothing where all is well
    assert rlds.read(path).num_episodes == (3 if name == "rmtree" else 2)
