"""Test that the server takes exported policies as it takes runs."""

import dataclasses

import numpy as np
import pytest
from rich.console import Console

from lorasp_jax.extras.serving import __main__ as command
from lorasp_jax.extras.serving import exported
from lorasp_jax.extras.serving.exported_policies import ExportedPolicies
from lorasp_jax.extras.serving.exporting import write
from tests.extras.serving.stand_in import connect, observation, serving
from tests.extras.serving.test_policies import compiled, make_policy, request

ROBOT = {"robot": "piper", "control_dt": 0.1}
OPTIONS = {"num_steps": 2, "max_batch": 2, "metadata": ROBOT}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("exports")
    write(make_policy(), root / "base", **OPTIONS)
    write(make_policy(seed=1), root / "other", **OPTIONS | {"max_batch": 1, "continues": True})
    return root


@pytest.fixture(scope="module")
def policies(folders):
    return {name: exported.load(folders / name) for name in ("base", "other")}


def load(*words):
    return command._load(command.parser("serve").parse_args(words), Console(quiet=True))


def test_actions_are_those_of_the_compiled_policies(policies):
    """With the noise of the same seed."""
    served = ExportedPolicies(policies, seed=3)
    expected = compiled({"base": make_policy(), "other": make_policy(seed=1)}, seed=3)
    assert served.spec == expected.spec
    assert served.instructions == expected.instructions
    assert (served.adapters, served.sizes) == (("base", "other"), (1,))
    sent = request(served.spec, absent=["wrist"])
    for adapter in served.adapters:
        asked = dataclasses.replace(sent, adapter=adapter)
        actions = [p.run(adapter, [p.prepare(asked, (2, 5))]) for p in (served, expected)]
        np.testing.assert_allclose(*actions, atol=1e-5)


def test_chunks_continue_as_those_of_the_compiled_policies(policies):
    served = ExportedPolicies({"other": policies["other"]}, execution="trained")
    expected = compiled({"other": make_policy(seed=1)}, execution="trained")
    first = request(served.spec)
    previous = served.run("other", [served.prepare(first, (0, 0))])[0]
    second = dataclasses.replace(first, previous=previous, executed=1, delay=2)
    for index, asked in enumerate((first, second)):
        actions = [p.run("other", [p.prepare(asked, (0, index))]) for p in (served, expected)]
        np.testing.assert_allclose(*actions, atol=1e-5)
    np.testing.assert_allclose(actions[0][0, :2], previous[1:3], atol=1e-5)


def test_a_server_of_exported_policies(folders):
    policy, metadata = load(str(folders / "base"), "--prompt", "push the button")
    assert (policy.sizes, metadata) == ((1, 2), ROBOT)
    with serving(policy, metadata=metadata) as server, connect(server) as client:
        assert client.metadata["robot"] == "piper"
        sent = observation(policy.spec)
        del sent["prompt"]
        assert client.infer(sent)["actions"].shape == (4, 7)
        with pytest.raises(Exception, match="must be one of 'press the button', 'push the button'"):
            client.infer(sent | {"prompt": "dance"})


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--num-steps", "5"], "--num-steps has no effect on exported policies"),
        (["--max-batch", "2"], "--max-batch has no effect on exported policies"),
        (["--base", "x"], "--base has no effect on exported policies"),
        (["--joints", "6"], "--joints has no effect on exported policies"),
        (["--execution", "guided"], "exported policies cannot be guided: use --execution naive or"),
        (["--execution", "trained"], "base was not trained to continue chunks"),
        (["assets/pi0_nano"], "several policies must all be finished runs, or all be exported"),
    ],
)
def test_what_exported_policies_cannot_do(folders, words, sentence):
    with pytest.raises(ValueError, match=sentence):
        load(str(folders / "base"), *words)


def test_policies_of_different_robots_are_not_served_together(policies):
    needs = dataclasses.replace(policies["base"].description, metadata={"robot": "panda"})
    other = exported.ExportedPolicy(needs, {}, [], {}, {})
    with pytest.raises(ValueError, match="must agree on their metadata"):
        ExportedPolicies({"base": policies["base"], "panda": other})
