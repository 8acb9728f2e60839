"""Test vla-eval's protocol with the package itself: its harness, its connection, a benchmark."""

import gc
import json
import os
import signal
import socket
import threading

import anyio
import numpy as np
import pytest

from lorasp_jax.extras.serving import __main__ as command
from tests.extras.serving.stand_in import SPEC, StandIn

vla_eval = pytest.importorskip("vla_eval")

from vla_eval.benchmarks.base import StepBenchmark, StepResult  # noqa: E402
from vla_eval.model_servers.base import SessionContext  # noqa: E402

from lorasp_jax.extras.serving.vla_eval import VlaEvalServer  # noqa: E402

STEPS = 7
# Its queue of requests, with which it builds batches, is left to the garbage collector.
pytestmark = pytest.mark.filterwarnings("ignore:Unclosed <MemoryObject:ResourceWarning")


@pytest.fixture(autouse=True)
def _collect():
    yield
    gc.collect()


class Toy(StepBenchmark):
    """Its state is the number of the step, and its cameras have other names than the policy's."""

    actions: list = []  # noqa: RUF012

    def __init__(self, size=7, state="states", send_wrist_image=False, send_state=False):
        super().__init__()
        self.size, self.state, self.wrist, self.sends = size, state, send_wrist_image, send_state

    def get_tasks(self):
        return [{"name": "one"}, {"name": "two"}]

    def reset(self, task):
        self.actions.append([])
        return 0

    def step(self, action):
        self.actions[-1].append(action["actions"])
        done = self._last_result.obs + 1 == STEPS
        return StepResult(self._last_result.obs + 1, 0.0, done, {"success": done})

    def make_obs(self, raw_obs, task):
        names = ["front", "hand"] if self.wrist else ["front"]
        images = {n: np.full((32, 32, 3), 10 * (i + 1), np.uint8) for i, n in enumerate(names)}
        state = {self.state: np.full(self.size, raw_obs, np.float32)} if self.sends else {}
        return {"images": images, "task_description": "go", **state}

    def get_step_result(self, step_result):
        return step_result.info

    def get_action_spec(self):
        return {}

    def get_observation_spec(self):
        return {}


class Counting(StandIn):
    """Adds 100 times its number to each action of a chunk."""

    def run(self, adapter, rows):
        chunks, ranks = super().run(adapter, rows)
        return chunks + 100 * np.arange(self.spec.chunk)[None, :, None], ranks


@pytest.fixture
def config(tmp_path):
    Toy.actions = []
    params = {"size": 7, "state": "states"}
    entry = {"benchmark": f"{__name__}:Toy", "episodes_per_task": 2, "params": params}
    return {"output_dir": str(tmp_path), "benchmarks": [entry]}


def test_an_evaluation_asks_the_policy_once_a_chunk(config, tmp_path):
    policy = Counting()
    (result,) = vla_eval.evaluate(VlaEvalServer(policy, 5), config, docker=False)
    assert (result["mean_success"], result["num_errors"]) == (1.0, 0)
    written = json.loads(next(tmp_path.glob("*.json")).read_text())
    assert written["num_episodes_total"] == 4
    # The first picture's mean, the state, the number of the request's step, that of the action.
    expected = [10 + i * 100 for i in range(5)] + [10 + 5 + 5 + i * 100 for i in range(2)]
    assert len(Toy.actions) == 4
    for episode in Toy.actions:
        np.testing.assert_array_equal(np.stack(episode), np.repeat(expected, 7).reshape(7, 7))
    assert list(policy.last_request.images) == list(SPEC.cameras)
    np.testing.assert_array_equal(policy.last_request.images["wrist"], 20)


def test_noise_differs_between_episodes_and_repeats(config):
    policy = StandIn()
    config["benchmarks"][0]["params"]["state"] = "state"
    for _ in range(2):
        vla_eval.evaluate(VlaEvalServer(policy, 5), config, docker=False)
    first, second = policy.indices[: 4 * STEPS], policy.indices[4 * STEPS :]
    assert first == second
    assert len({number for number, _ in first}) == 4
    assert [step for _, step in first] == [*range(STEPS)] * 4
    assert policy.batches == [("base", 1)] * 16, "at steps 0 and 5 of each episode"
    assert all(0 <= number < 2**31 for number, _ in first)


@pytest.mark.parametrize(
    ("params", "sentence"),
    [
        ({"size": 8}, "state must have 7 values, got 8"),
        ({"send_state": False}, "send_state=true; got images, task_description"),
        ({"send_wrist_image": False}, "must contain the picture image/wrist"),
    ],
)
def test_the_benchmark_gets_a_sentence_about_an_observation(config, params, sentence):
    config["benchmarks"][0]["params"] |= params
    (result,) = vla_eval.evaluate(VlaEvalServer(StandIn(), 5), config, docker=False)
    assert result["num_errors"] == 4
    details = [each["failure_detail"] for task in result["tasks"] for each in task["episodes"]]
    assert all(sentence in text for text in details)


def test_one_bad_observation_does_not_fail_its_batch():
    """Clients of both kinds answer at the same time, in batches of up to 8."""

    class Session(SessionContext):
        async def send_action(self, action):
            answers.append((self.session_id, action["actions"]))

    async def ask(server, name, size):
        context = Session(name, "episode")
        await server.on_episode_start({"task": {"name": name}}, context)
        toy = Toy(size=size, send_wrist_image=True, send_state=True)
        try:
            await server.on_observation(toy.make_obs(0, {}), context)
        except ValueError as error:
            answers.append((name, str(error)))

    async def work():
        policy.gate.clear()
        async with anyio.create_task_group() as tasks:
            server = VlaEvalServer(policy, 5)
            await server.on_serve_start(tasks)
            async with anyio.create_task_group() as clients:
                for name, size in {"a": 7, "bad": 8, "c": 7}.items():
                    clients.start_soon(ask, server, name, size)
                await anyio.sleep(0.3)
                policy.gate.set()
            tasks.cancel_scope.cancel()

    policy, answers = StandIn(), []
    anyio.run(work)
    found = dict(answers)
    assert "state must have 7 values, got 8" in found.pop("bad")
    assert {name: actions[0] for name, actions in found.items()} == {"a": 10, "c": 10}


def test_larger_batches_than_there_are_programs_for():
    policy = StandIn()
    server = VlaEvalServer(policy, 5)
    context = SessionContext("session", "episode")
    server._episodes["session"] = 3
    toy = Toy(send_wrist_image=True, send_state=True)
    rows = [server._row(toy.make_obs(i, {}), context) for i in range(11)]
    answers = server.predict_batch(rows, [context] * 11)
    assert [size for _, size in policy.batches] == [8, 4]
    assert [each["actions"][0, 0] for each in answers] == [10 + i for i in range(11)]


@pytest.mark.parametrize(
    ("policy", "replan", "sentence"),
    [
        (StandIn(), 11, "from 1 to 10"),
        (StandIn(adapters=("a", "b")), 5, "one policy"),
    ],
)
def test_what_cannot_be_served(policy, replan, sentence):
    with pytest.raises(ValueError, match=sentence):
        VlaEvalServer(policy, replan)


def test_serving_until_an_interrupt(config, monkeypatch, capsys):
    monkeypatch.setattr(command, "_load", lambda *_: StandIn())
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def judge():
        try:
            found.extend(vla_eval.run(config, server_url=f"ws://127.0.0.1:{port}", docker=False))
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    found = []
    thread = threading.Thread(target=judge)
    thread.start()
    assert command.main(["runs/any", "--port", str(port), "--vla-eval", "5"]) == 0
    thread.join()
    assert found[0]["mean_success"] == 1.0
    lines = capsys.readouterr().out.splitlines()
    assert f"listening on ws://127.0.0.1:{port}" in lines


@pytest.mark.parametrize("words", [["--token-file", "token"], ["--max-clients", "64"]])
def test_what_has_no_effect_is_refused(words, capsys):
    assert command.main(["runs/any", *words, "--vla-eval", "5"]) == 2
    assert f"{words[0]} has no effect with --vla-eval" in capsys.readouterr().err
