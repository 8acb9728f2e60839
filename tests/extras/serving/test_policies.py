"""Test that a served policy gives the same actions as `Policy.sample`, alone and in batches."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.extras.serving import policies, server
from lorasp_jax.extras.serving.loading import Loaded
from lorasp_jax.extras.serving.policies import CompiledPolicy, batch_sizes
from lorasp_jax.extras.serving.requests import Request
from lorasp_jax.extras.serving.served import ServedPolicies
from lorasp_jax.models.inputs import OPENPI
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.policies import tokenizer
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.statistics import Statistics
from tests.cases import mostly_slow
from tests.models.random_models import random_backbone

INSTRUCTIONS = ("press the button", "push the button")
WORDS = tokenizer.Offline()
STEPS = 2
_JOINTS = [*(f"joint_{n}" for n in range(1, 7)), "gripper"], [*(6 * ["rad"]), "m"]
SIMULATED = {"robot": "piper", "control_dt": 0.1} | {
    key: {"state": x, "action": x} for key, x in zip(("names", "units"), _JOINTS, strict=True)
}
"""What a run on simulated demonstrations says of its robot."""


def make_policy(
    config=None, *, seed=0, instructions=INSTRUCTIONS, cameras=None, dims=7, action_dims=0
):
    config = config or Pi0Config.dummy()
    rng = np.random.default_rng(1 + seed)
    moments = {"mean": rng.normal(size=dims), "std": rng.uniform(0.5, 1, dims)}
    moments = {name: np.float32(values) for name, values in moments.items()}
    length = action_dims or dims
    statistics = Statistics(moments, {name: values[:length] for name, values in moments.items()})
    prompts = PromptTable.of(WORDS, instructions, config, num_joints=dims - 1)
    sizes = {"num_joints": dims - 1, "action_length": length}
    processor = Processor.of(config, statistics, prompts, **sizes, cameras=cameras)
    return Policy(random_backbone(config, seed=seed), processor)


def compiled(policies, *, max_batch=2, guidance=None, metadata=None, **options):
    settings = {"num_steps": STEPS, "max_batch": max_batch, "guidance": guidance}
    loaded = {name: Loaded(each, WORDS, None, metadata or {}) for name, each in policies.items()}
    made = {name: CompiledPolicy(each, **settings) for name, each in loaded.items()}
    return ServedPolicies(made, **options)


def request(spec, seed=0, prompt=INSTRUCTIONS[1], absent=(), **fields):
    rng = np.random.default_rng(seed)
    shape = (spec.image_size, spec.image_size, 3)
    pictures = {name: rng.integers(0, 255, shape, np.uint8) for name in spec.cameras}
    images = {name: picture for name, picture in pictures.items() if name not in absent}
    return Request(images, rng.normal(size=spec.state_dim).astype(np.float32), prompt, **fields)


def reference(policy, sent, noise, *, absent=(), **condition):
    """Actions of the policy itself for requests with the same prompt."""
    images = {name: np.stack([each.images[name] for each in sent]) for name in sent[0].images}
    seen = {"image": images, "state": np.stack([each.state for each in sent])}
    rows = jnp.asarray(policy.processor.prompts.rows([each.prompt for each in sent]))
    return np.asarray(_reference(policy, seen, rows, noise, condition, absent=tuple(absent)))


@functools.partial(jax.jit, static_argnames="absent")
def _reference(policy, seen, rows, noise, condition, *, absent):
    processor = policy.processor
    encoded = processor.encode(seen, rows)
    for name in absent:
        masks = {**encoded.image_masks, name: jnp.zeros(len(rows), bool)}
        pictures = {**encoded.images, name: 0 * encoded.images[name] - 1}
        encoded = dataclasses.replace(encoded, images=pictures, image_masks=masks)
    if condition:
        prefix = processor.normalize_actions(condition["prefix"], seen["state"])
        condition = condition | {"prefix": prefix}
    chunk = policy.model.sample_actions(
        None, encoded, num_steps=STEPS, noise=noise, slots=processor.flow_slots, **condition
    )
    return processor.decode(chunk, seen["state"])


def noise_of(spec, connection=0, request=0):
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(0), connection), request)
    return jax.random.normal(key, (1, spec.chunk, Pi0Config.dummy().action_dim))


def actions(served, *requests, index=(0, 0)):
    adapter = served.route(requests[0])
    return served.run(adapter, [served.prepare(adapter, each, index) for each in requests])[0]


def prepared(served, sent):
    return served.prepare(served.route(sent), sent, (0, 0))


@pytest.fixture(scope="module")
def served():
    return compiled({"base": make_policy(), "other": make_policy(seed=1)})


def test_actions_are_those_of_the_policy(served):
    """With the noise of the server's key."""
    sent = request(served.spec)
    expected = reference(make_policy(), [sent], noise_of(served.spec, connection=2, request=3))
    found = actions(served, sent, index=(2, 3))
    assert found.shape == (1, 4, 7)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_row_does_not_depend_on_the_others_of_its_batch(served):
    a, b = request(served.spec, 0), request(served.spec, 1, prompt=INSTRUCTIONS[0])
    together = actions(served, a, b)
    np.testing.assert_allclose(together[:1], actions(served, a), atol=1e-5)
    np.testing.assert_allclose(together[1:], actions(served, b), atol=1e-5)
    assert np.abs(together[0] - together[1]).max() > 0.01


def test_everything_in_a_request_matters(served):
    first = actions(served, request(served.spec))
    changed = [
        actions(served, request(served.spec, prompt="lift the lid")),
        actions(served, request(served.spec), index=(0, 1)),
        actions(served, request(served.spec), index=(1, 0)),
        actions(served, request(served.spec, adapter="other")),
        actions(served, request(served.spec, absent=["wrist"])),
    ]
    assert all(np.abs(first - other).max() > 1e-4 for other in changed)


@pytest.mark.parametrize("execution", mostly_slow(["trained", "guided"], ["guided"]))
def test_a_chunk_continues_what_remains_of_the_previous_one(execution, served):
    """The rows of a batch may differ in how much remains and is executed."""
    guidance = 10.0 if execution == "guided" else None
    policy, spec = make_policy(), served.spec
    continuing = compiled({"base": policy}, execution=execution, guidance=guidance)
    previous = np.random.default_rng(5).normal(size=(2, spec.chunk, 7)).astype(np.float32)
    pairs = [(1, 2), (2, 1)]
    sent = [
        request(spec, i, executed=s, delay=d, previous=previous[i])
        for i, (s, d) in enumerate(pairs)
    ]
    rest = np.stack([np.pad(previous[i, s:], ((0, s), (0, 0))) for i, (s, _) in enumerate(pairs)])
    expected = reference(
        policy,
        sent,
        np.repeat(noise_of(spec), 2, axis=0),
        prefix=rest,
        prefix_length=np.array([2, 1]),
        overlap=np.array([3, 2]),
        guidance=guidance,
    )
    found = actions(continuing, *sent)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    if execution == "trained":
        np.testing.assert_allclose(found[0, :2], previous[0, 1:3], atol=1e-5)
        np.testing.assert_allclose(found[1, :1], previous[1, 2:3], atol=1e-5)
    # Without a previous chunk, or with one that was executed to its end, chunks are independent.
    done = dataclasses.replace(sent[1], executed=spec.chunk, delay=0)
    alone = actions(served, request(spec, 0), request(spec, 1))
    np.testing.assert_allclose(actions(continuing, request(spec, 0), done), alone, atol=1e-5)


def test_names_and_units_are_said_of_each_adapter():
    """They may differ, unlike the robot."""
    robot = {"robot": "piper", "control_dt": 0.1}
    recorded = robot | {"names": {"state": ["a.pos"], "action": ["a.pos"]}}
    said = SIMULATED, recorded, robot
    made = {
        name: CompiledPolicy(Loaded(make_policy(), WORDS, None, each))
        for name, each in zip("abc", said, strict=True)
    }
    found = server.describe(ServedPolicies(made))
    assert found["names"] == {"a": SIMULATED["names"], "b": recorded["names"]}
    assert found["units"] == {"a": SIMULATED["units"]}
    assert found["robot"] == "piper"
    assert not {"names", "units"} & server.describe(ServedPolicies({"c": made["c"]})).keys()


def test_programs_are_shared_and_compiled_in_advance():
    policies_of_two = {"base": make_policy(), "other": make_policy(seed=1)}
    fresh, progress, program = compiled(policies_of_two), [], policies._program()
    program.clear_cache()
    fresh.warm_up(progress.append)
    assert progress[-1] == "compiling other, batch 2 (4 of 4)"
    assert program._cache_size() == 2
    actions(fresh, request(fresh.spec, prompt="open the pot", adapter="other"), index=(7, 7))
    assert program._cache_size() == 2


def test_prompts(served):
    with pytest.raises(ValueError, match="must contain a prompt"):
        prepared(served, request(served.spec, prompt=None))
    with pytest.raises(ValueError, match="ASCII"):
        prepared(served, request(served.spec, prompt="鼠"))
    single = compiled({"base": make_policy(instructions=("open the pot",))})
    default = compiled({"base": make_policy()}, prompt="open the pot")
    expected = prepared(served, request(served.spec, prompt="open the pot"))["ids"]
    for each in (single, default):
        found = prepared(each, request(served.spec, prompt=None))["ids"]
        np.testing.assert_array_equal(found, expected)
    assert single.instructions == {"base": ("open the pot",)}


def test_cameras_have_the_robots_names(served):
    assert served.spec.cameras == ("side", "wrist")
    renamed = make_policy(cameras={"side": "front"})
    spec = compiled({"a": renamed}).spec
    assert (spec.cameras, spec.state_dim, spec.chunk) == (("front",), 7, 4)
    with pytest.raises(ValueError, match="a and b cannot be served together: their cameras"):
        compiled({"a": make_policy(), "b": renamed})


def test_batch_sizes():
    assert [batch_sizes(n) for n in (1, 2, 5, 8)] == [(1,), (1, 2), (1, 2, 4, 5), (1, 2, 4, 8)]


def test_a_prompt_table_for_other_instructions_is_the_same_as_a_new_one():
    for config in (Pi0Config.dummy(), dataclasses.replace(Pi0Config.dummy(), inputs=OPENPI)):
        table = PromptTable.of(WORDS, INSTRUCTIONS, config, num_joints=6)
        other = table.with_instructions(WORDS, ["lift the lid"])
        expected = PromptTable.of(WORDS, ["lift the lid"], config, num_joints=6)
        assert other.instructions == expected.instructions
        for a, b in zip(jax.tree.leaves(other), jax.tree.leaves(expected), strict=True):
            np.testing.assert_array_equal(a, b)


def test_policies_with_and_without_endings_make_one_program():
    def structure(endings):
        policy = make_policy()
        prompts = dataclasses.replace(policy.processor.prompts, endings=endings)
        processor = dataclasses.replace(policy.processor, prompts=prompts)
        bare = policies.without_prompts(dataclasses.replace(policy, processor=processor))
        return jax.tree.structure(bare.processor)

    assert structure(("",)) == structure((" good", " bad", ""))


def test_a_state_that_no_demonstration_had_is_logged_once(caplog):
    served = compiled({"a": make_policy()}, max_batch=1)
    spec = served.spec
    for unit in (1.0, 1.0, 60.0, 60.0):  # radians, then degrees
        prepared(served, dataclasses.replace(request(spec), state=np.full(7, unit, np.float32)))
        assert len(caplog.records) == (unit > 1)
    assert "a state is 60, but" in caplog.text
    caplog.clear()
    served.warm_up()
    assert not caplog.records
