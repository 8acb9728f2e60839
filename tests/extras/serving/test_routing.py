"""Test that instructions choose the right adapter, or none."""

from types import SimpleNamespace

import numpy as np
import pytest

from envs.tasks import open_pot, pick_place, pour, press
from lorasp_jax import models
from lorasp_jax.extras.piper.remote import Server
from lorasp_jax.extras.serving import exported, routing
from lorasp_jax.extras.serving.served import ServedPolicies
from lorasp_jax.policies.tokenizer import Offline
from tests import ROOT
from tests.extras.serving.adapter_runs import TEXTS, serve_runs, write_run
from tests.extras.serving.test_policies import actions, compiled, make_policy, request

TASKS = {task.TASK.name: task.TASK.instructions for task in (press, pick_place, open_pot, pour)}
PARAPHRASES = {
    "press": [
        "please press the red button",
        "push the red button",
        "press the button",
        "hit the button on the table",
        "push down the button",
        "tap the red button",
        "press down on the red button",
        "click the red button",
        "push the red knob down",
        "press the red switch",
        "touch the red button",
        "hit the button",
    ],
    "pick_place": [
        "put the grape into the basket",
        "place the grape in the basket",
        "pick up the grape and put it in the basket",
        "move the grape into the basket",
        "drop the grape into the basket please",
        "grab the grape and drop it in the basket",
        "take the grape to the basket",
        "put the fruit in the basket",
        "place the berry in the bowl",
        "lift the grape and place it in the basket",
        "bring the grape to the basket",
        "put a grape in the bin",
    ],
    "open_pot": [
        "open the lid of the pot",
        "take off the lid",
        "lift the lid off the pot",
        "remove the lid",
        "uncover the pot please",
        "take the lid from the pot",
        "open up the pot",
        "remove the cover of the pot",
        "lift the lid",
        "put the lid of the pot down",
        "pull the lid off the pot",
        "raise the pot lid",
    ],
    "pour": [
        "pour the cup into the basket",
        "tip the cup over the basket",
        "empty the cup over the basket",
        "pour out the cup",
        "tilt the cup over the basket",
        "pour the block from the cup into the basket",
        "tip the block out of the cup",
        "empty the block into the basket",
        "pour the contents of the cup into the basket",
        "tilt the cup so the block falls in the basket",
        "pour the cube into the basket",
        "tip over the mug above the basket",
    ],
}
OTHERS = [
    "open the drawer",
    "fold the towel",
    "wipe the table",
    "hand me the screwdriver",
    "go home",
    "stack the blue block on the red block",
    "close the door",
    "water the plant",
    "put the cup on the shelf",
    "close the pot",
    "stop",
    "wave",
    "press the blue button",
    "put the lid on the pot",
    "put the grape on the plate",
    "put the block in the basket",
    "move the basket to the left",
    "turn on the light",
    "pick up the pen",
    "what is the weather",
]


@pytest.fixture(scope="module")
def embed():
    table = np.asarray(models.load(ROOT / "assets/pi0_nano").language.embedding, np.float32)

    def embed(text):
        ids, mask = Offline().encode([text], 64)
        return table[ids[0][mask[0]]].mean(axis=0)

    return embed


def test_no_paraphrase_goes_to_another_task(embed):
    """An instruction itself is a paraphrase where its task does not know it."""
    routed = [(task, text, TASKS) for task, texts in PARAPHRASES.items() for text in texts]
    for task, texts in TASKS.items():
        for text in texts:
            rest = TASKS | {task: tuple(other for other in texts if other != text)}
            routed.append((task, text, rest))
    found = {(task, text): routing.nearest(text, known, embed)[0] for task, text, known in routed}
    assert {each: name for each, name in found.items() if name not in (each[0], "")} == {}
    assert sum(bool(name) for name in found.values()) >= 61  # of 68


def test_most_commands_for_other_tasks_are_refused(embed):
    taken = [text for text in OTHERS if routing.nearest(text, TASKS, embed)[0]]
    assert len(taken) <= 4, "those have almost only known words"


def test_exact_instructions_ignore_case_and_spaces():
    assert routing.exact(" Open  the pot.", TASKS) == "open_pot"
    assert routing.exact("open the lid", TASKS) == ""
    with pytest.raises(ValueError, match="an instruction of a, b"):
        routing.exact("go", {"a": ["go"], "b": ["go", "stop"]})


def test_a_trained_instruction_is_found_by_its_words():
    texts = ("open the pot", "Open the pot")
    assert routing.trained("OPEN the  pot!", texts) == "open the pot"
    assert routing.trained("Open the pot", texts) == "Open the pot", "these two differ in a letter"
    assert routing.trained("open the lid", texts) == ""


def test_exported_policies_take_other_letter_cases(folder, loaded):
    known = loaded.instructions[0]
    served = ServedPolicies({"base": exported.load(folder)}, route="exact")
    expected = actions(served, request(served.spec, 0, known))
    for prompt in (known.upper(), f" {known}. "):
        np.testing.assert_array_equal(actions(served, request(served.spec, 0, prompt)), expected)
    with pytest.raises(ValueError, match="no adapter is for 'dance'"):
        actions(served, request(served.spec, 0, "dance"))


def test_an_arm_is_warned_of_prompts_that_no_adapter_may_answer(capsys):
    """If the server chooses by the prompt, all adapters may answer, otherwise the first."""

    def warned(prompt, adapter="", **metadata):
        client.metadata = {"adapters": ["a", "b"], "instructions": {"a": ["go"], "b": ["stop"]}}
        client.metadata |= metadata
        Server(client, adapter).warn([prompt])
        return "warning" in capsys.readouterr().out

    client = SimpleNamespace()
    assert warned("stop")
    assert not warned("stop", route="exact")
    assert warned("dance", route="exact")
    assert warned("stop", "a", route="exact")


def test_only_policies_on_a_shared_base_are_nearest(finished, tmp_path):
    run = write_run(finished.folder, tmp_path / "run", 0, TEXTS["press"])
    served = serve_runs({"press": run}, share=False, max_batch=1, route="nearest")
    with pytest.raises(ValueError, match="needs policies that share a base"):
        served.route(request(served.spec, 0, "press it"))


def test_instructions_of_several_adapters_are_said_at_the_start_if_they_choose(caplog):
    known = {"a": ["Go.", "stop"], "b": ["go", "wait"], "c": ["stop", "Go"]}
    assert routing.shared(known) == {"Go.": ["a", "b", "c"], "stop": ["a", "c"]}
    policies = {"press": make_policy(), "again": make_policy(seed=1)}
    compiled(policies)
    assert not caplog.messages
    compiled(policies, route="exact")
    (said,) = caplog.messages
    assert "(2, such as 'press the button' of press and again): requests with these must" in said
    apart = policies | {"again": make_policy(instructions=("open the pot",))}
    compiled(apart, route="exact")
    assert len(caplog.messages) == 1


def test_nothing_is_near_where_nothing_is_known(embed):
    assert routing.nearest("go", {"a": ()}, embed)[0] == ""


@pytest.mark.parametrize("mode", routing.MODES)
def test_a_request_finds_its_adapter(mode, finished, tmp_path):
    runs = {n: write_run(finished.folder, tmp_path / n, 0, texts) for n, texts in TEXTS.items()}
    served = serve_runs(runs, route=mode)
    route = lambda prompt, **more: served.route(request(served.spec, 0, prompt, **more)).name  # noqa: E731
    assert route("dance", adapter="open") == "open"
    if mode == "name":
        assert route("open the pot") == "press"
        return
    assert route("open the pot") == "open"
    with pytest.raises(ValueError, match=r"no adapter is for 'dance': .*; name the adapter"):
        route("dance")
