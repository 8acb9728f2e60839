"""Test the tasks as a benchmark of vla-eval, with the package's own harness."""

import jax
import numpy as np
import pytest

import envs

vla_eval = pytest.importorskip("vla_eval")

from vla_eval.model_servers.predict import PredictModelServer  # noqa: E402
from vla_eval.specs import STATE_JOINT, DimSpec, check_specs  # noqa: E402

from lorasp_jax.extras.judge.vla_eval import SimulatedTasks  # noqa: E402


@pytest.fixture(scope="module")
def benchmark():
    return SimulatedTasks(["press", "pour"], image_size=16)


def test_tasks_and_limits(benchmark):
    assert [task["name"] for task in benchmark.get_tasks()] == ["press", "pour"]
    assert benchmark.get_metadata()["max_steps"] == envs.make("pour").max_steps
    with pytest.raises(ValueError, match="unknown task 'juggle': choose from"):
        SimulatedTasks(["juggle"])


def test_specs_are_compared(benchmark):
    """A server of joint positions fits, one of the hand's displacements is warned of."""
    fits = {"actions": DimSpec("actions", 7, "raw")}, {"state": STATE_JOINT}
    other = {"actions": DimSpec("actions", 7, "delta_xyz")}
    own = benchmark.get_action_spec(), benchmark.get_observation_spec()
    assert not check_specs(fits[0], own[0], fits[1], own[1])
    assert len(check_specs(other, own[0], fits[1], own[1])) == 1
    blind = SimulatedTasks(["press"], send_state=False).get_observation_spec()
    assert any("state" in text for text in check_specs(fits[0], own[0], fits[1], blind))


class Still(PredictModelServer):
    """Holds the arm where it is; keeps what it sees."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def predict(self, obs, ctx):
        self.seen.append(obs)
        return {"actions": obs["states"]}


@pytest.mark.slow
def test_an_episode_is_that_of_the_environment(tmp_path):
    """In vla-eval's own harness: what is seen, how long it takes, and that holding fails."""
    name, params = f"{SimulatedTasks.__module__}:SimulatedTasks", {"tasks": ["press"], "seed": 3}
    entry = {"benchmark": name, "episodes_per_task": 2, "params": {**params, "image_size": 16}}
    server, config = Still(), {"output_dir": str(tmp_path), "benchmarks": [entry]}
    (result,) = vla_eval.evaluate(server, config, docker=False)
    env = envs.make("press", image_size=16)
    episodes = result["tasks"][0]["episodes"]
    assert [each["steps"] for each in episodes] == [env.max_steps] * 2
    assert (result["mean_success"], result["num_errors"]) == (0.0, 0)
    state = env.reset(jax.random.fold_in(jax.random.key(3), 1))
    expected, seen = env.observe(state), server.seen[env.max_steps]
    assert list(seen["images"]) == ["side", "wrist"]
    for camera, picture in seen["images"].items():
        np.testing.assert_array_equal(picture, expected["image"][camera][0])
    np.testing.assert_allclose(seen["states"], expected["state"][0], atol=1e-6)
    assert seen["task_description"] == env.instructions[int(state.info["instruction"][0])]


@pytest.mark.slow
def test_actions_of_another_shape_are_refused(benchmark):
    benchmark._last_result.obs = benchmark.reset({"name": "press", "episode_idx": 0})
    for actions in (np.zeros(8), np.zeros((10, 7))):
        with pytest.raises(ValueError, match=r"action.*shape"):
            benchmark.step({"actions": actions})
    with pytest.raises(ValueError, match="must send actions, got action"):
        benchmark.step({"action": np.zeros(7)})
