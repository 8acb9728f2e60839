"""Episodes on disk and in memory."""

import dataclasses
import zipfile

import jax
import numpy as np
import pytest

from envs.datasets.episodes import Episodes, concatenate


def make(episodes=3, steps=4, **changes):
    rng = np.random.default_rng(episodes)
    size = (episodes, steps)
    values = {
        "image": {
            name: rng.integers(0, 256, (*size, 6, 8, 3), dtype=np.uint8)
            for name in ("side", "wrist")
        },
        "state": rng.normal(size=(*size, 7)).astype(np.float32),
        "action": rng.normal(size=(*size, 7)).astype(np.float32),
        "length": np.arange(1, episodes + 1, dtype=np.int32).clip(max=steps),
        "instruction": np.arange(episodes, dtype=np.int32) % 2,
        "instructions": ("press the button", "push the red button"),
        "task": "press",
        "robot": "piper",
        "control_dt": 0.1,
        "physics_dt": 0.005,
        "attempted": episodes + 1,
    }
    return Episodes(**values | changes)


def assert_equal(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)


def test_round_trip(tmp_path):
    episodes = make()
    path = tmp_path / "new folder" / "press.npz"
    jax.tree.map(jax.numpy.asarray, episodes).save(path)  # device arrays too
    assert_equal(Episodes.load(path, control_dt=0.1), episodes)
    assert [file.name for file in path.parent.iterdir()] == ["press.npz"]
    assert episodes.num_episodes == 3
    assert episodes.num_steps == 1 + 2 + 3


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_arrays_of_the_same_name_are_refused(tmp_path):
    make().save(path := tmp_path / "press.npz")
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("state.npy", archive.read("action.npy"))
    with pytest.raises(ValueError, match="same name"):
        Episodes.load(path)


def test_repr_is_one_line():
    text = repr(make(3, 4))
    assert "image/side=uint8[3, 4, 6, 8, 3]" in text
    assert "task='press', robot='piper'" in text
    assert len(text) < 500
    assert "state=float32[3, 4, 7]" in repr(jax.eval_shape(lambda: make(3, 4)))
    assert "state=0" in repr(jax.tree.map(lambda _: 0, make(3, 4)))


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"action": np.zeros((3, 4, 6), np.float32)}, r"action .*3, 4, 7"),
        ({"action": np.zeros((3, 4, 7))}, "action .* float64"),
        ({"image": {"side": np.zeros((3, 4, 6, 8), np.uint8)}}, "'side'"),
        ({"image": {"wrist": np.zeros((3, 4, 6, 8, 3), np.float32)}}, "'wrist'"),
        ({"image": {}}, "camera"),
        ({"length": np.array([1, 5, 2], np.int32)}, "length"),
        ({"instruction": np.array([0, 1, 2], np.int32)}, "instruction"),
        ({"length": np.array([1, 2, 3], np.float32)}, "length"),
    ],
)
def test_bad_contents(changes, name):
    with pytest.raises(ValueError, match=name):
        make(**changes).validate()


def test_foreign_files(tmp_path):
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    for name in ("other.npz", "missing.npz"):
        with pytest.raises(ValueError, match=name):
            Episodes.load(tmp_path / name)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite(value):
    episodes = make()
    action = np.array(episodes.action)
    action[1, 2, 3] = value
    with pytest.raises(ValueError, match=r"action .* episode 1, step 2, dimension 3"):
        dataclasses.replace(episodes, action=action).validate()


def test_every_action_mode(tmp_path):
    panda = {"robot": "panda", "state": np.zeros((3, 4, 8), np.float32)}
    tool = make(**panda, actions="end_effector", action=np.ones((3, 4, 7), np.float32))
    tool.save(tmp_path / "e.npz")
    assert_equal(Episodes.load(tmp_path / "e.npz"), tool)
    with pytest.raises(ValueError, match=r"action .*\(3, 4, 8\)"):
        dataclasses.replace(tool, actions="joint").validate()
    with pytest.raises(ValueError, match="joint, delta_joint, end_effector"):
        make(actions="voltage").validate()


def test_other_control_period(tmp_path):
    make(control_dt=0.05).save(tmp_path / "e.npz")
    with pytest.raises(ValueError, match=r"0\.05, not 0\.1"):
        Episodes.load(tmp_path / "e.npz", control_dt=0.1)


def test_failed_save_keeps_the_old_file(tmp_path):
    path = tmp_path / "episodes.npz"
    make().save(path)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="length"):
        dataclasses.replace(make(), length=np.array([9, 9, 9])).save(path)
    assert path.read_bytes() == before


def test_select_keeps_order():
    episodes = make()
    chosen = episodes.select([2, 0])
    np.testing.assert_array_equal(chosen.action, episodes.action[[2, 0]])
    np.testing.assert_array_equal(chosen.image["wrist"], episodes.image["wrist"][[2, 0]])
    assert chosen.task == "press"


def test_concatenate_pads_to_the_longest():
    short, long = make(2, 3), make(3, 5)
    both = concatenate([short, long])
    both.validate()
    assert both.num_episodes == 5
    assert both.num_steps == short.num_steps + long.num_steps
    assert both.attempted == 7
    np.testing.assert_array_equal(both.image["side"][:2, :3], short.image["side"])
    assert not both.action[:2, 3:].any()
    np.testing.assert_array_equal(both.state[2:], long.state)
    assert isinstance(both.state, np.ndarray)


@pytest.mark.parametrize(
    "changes",
    [{"robot": "panda"}, {"control_dt": 0.2}, {"task": "pour"}, {"actions": "delta_joint"}],
)
def test_concatenate_refuses_mixed_metadata(changes):
    with pytest.raises(ValueError, match=f"same {next(iter(changes))}"):
        concatenate([make(), make(**changes)])
    with pytest.raises(ValueError, match="parts"):
        concatenate([])
