"""Test that a compiled policy gives the same actions as `Policy.sample`, alone and in batches."""

import dataclasses

import jax
import numpy as np
import pytest

from lorasp_jax.extras.serving.policies import CompiledPolicies, batch_sizes, spec_of
from lorasp_jax.extras.serving.requests import Request
from lorasp_jax.models.inputs import OPENPI
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.policies import tokenizer
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.statistics import Statistics
from tests.models.random_models import random_backbone

INSTRUCTIONS = ("press the button", "push the button")
WORDS = tokenizer.Offline()


def make_policy(config=None, *, seed=0, instructions=INSTRUCTIONS, cameras=None):
    config = config or Pi0Config.dummy()
    rng = np.random.default_rng(1)
    moments = {"mean": rng.normal(size=7), "std": rng.uniform(0.5, 1, 7)}
    statistics = Statistics(*({k: np.float32(v) for k, v in moments.items()} for _ in range(2)))
    prompts = PromptTable.of(WORDS, instructions, config, num_joints=6)
    processor = Processor.of(config, statistics, prompts, num_joints=6, cameras=cameras)
    return Policy(random_backbone(config, seed=seed), processor)


def compiled(policies, steps=2, **options):
    words = dict.fromkeys(policies, WORDS)
    return CompiledPolicies(policies, words, max_batch=2, num_steps=steps, **options)


def request(spec, seed=0, prompt=INSTRUCTIONS[1], absent=()):
    rng = np.random.default_rng(seed)
    shape = (spec.image_size, spec.image_size, 3)
    pictures = {name: rng.integers(0, 255, shape, np.uint8) for name in spec.cameras}
    images = {name: picture for name, picture in pictures.items() if name not in absent}
    state = rng.normal(size=spec.state_dim).astype(np.float32)
    return Request(images, state, prompt, None, False, 7)


@pytest.fixture(scope="module")
def served():
    return compiled({"base": make_policy(), "other": make_policy(seed=1)})


def noise_of(policy, spec, connection=0, request=0):
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(0), connection), request)
    return jax.random.normal(key, (1, spec.chunk, policy.model.config.action_dim))


def actions(served, *requests, adapter="base", index=(0, 0)):
    rows = [served.prepare(each, index) for each in requests]
    return served.run(adapter, rows)


def test_actions_are_those_of_the_policy(served):
    """With the noise of the server's key."""
    policy, sent = make_policy(), request(served.spec)
    noise = noise_of(policy, served.spec, connection=2, request=3)
    raw = {"image": {k: v[None] for k, v in sent.images.items()}, "state": sent.state[None]}
    encoded = policy.processor.encode(raw, np.array([1]))
    slots = policy.processor.flow_slots
    chunk = policy.model.sample_actions(None, encoded, num_steps=2, noise=noise, slots=slots)
    expected = policy.processor.decode(chunk, raw["state"])
    found = actions(served, sent, index=(2, 3))
    assert found.shape == (1, 4, 7)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_each_policy_has_its_own_instructions():
    known = {"a": ("open the pot",), "b": INSTRUCTIONS}
    policies = {name: make_policy(instructions=texts) for name, texts in known.items()}
    assert compiled(policies).instructions == known


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
        actions(served, request(served.spec), adapter="other"),
        actions(served, request(served.spec, absent=["wrist"])),
    ]
    assert all(np.abs(first - other).max() > 1e-4 for other in changed)


@pytest.fixture(scope="module", params=["trained", "guided"])
def continuing(request):
    return compiled({"base": make_policy()}, execution=request.param)


def test_a_chunk_continues_what_remains_of_the_previous_one(continuing):
    """The rows of a batch may differ in how much remains and is executed."""
    policy, spec = make_policy(), continuing.spec
    previous = np.random.default_rng(5).normal(size=(2, spec.chunk, 7)).astype(np.float32)
    sent = [
        dataclasses.replace(request(spec, i), executed=s, delay=d, previous=previous[i])
        for i, (s, d) in enumerate([(1, 2), (2, 1)])
    ]
    found = actions(continuing, *sent)
    for i, (s, d) in enumerate([(1, 2), (2, 1)]):
        raw = {
            "image": {k: v[None] for k, v in sent[i].images.items()},
            "state": sent[i].state[None],
        }
        noise = noise_of(policy, spec)
        chunk = policy.model.sample_actions(
            None,
            policy.processor.encode(raw, np.array([1])),
            num_steps=2,
            noise=noise,
            slots=policy.processor.flow_slots,
            prefix=policy.processor.normalize_actions(previous[i : i + 1, s:]),
            prefix_length=d,
            guidance=10.0 if spec.execution == "guided" else None,
        )
        np.testing.assert_allclose(found[i], policy.processor.decode(chunk)[0], atol=1e-4)
        if spec.execution == "trained":
            np.testing.assert_allclose(found[i, :d], previous[i, s : s + d], atol=1e-5)


def test_a_chunk_without_a_previous_one_is_independent(continuing, served):
    sent = request(served.spec)
    np.testing.assert_allclose(actions(continuing, sent), actions(served, sent), atol=1e-5)
    done = dataclasses.replace(sent, executed=served.spec.chunk, previous=np.ones((4, 7)))
    np.testing.assert_allclose(actions(continuing, done), actions(served, sent), atol=1e-5)


def test_programs_are_shared_and_compiled_in_advance():
    fresh, progress = compiled({"base": make_policy(), "other": make_policy(seed=1)}, steps=1), []
    earlier = fresh._sample._cache_size()  # JAX counts those of `served` too
    fresh.warm_up(lambda *step: progress.append(step))
    assert progress == [("base", 1), ("base", 2), ("other", 1), ("other", 2)]
    assert fresh._sample._cache_size() == earlier + 2
    actions(fresh, request(fresh.spec, prompt="open the pot"), adapter="other", index=(7, 7))
    assert fresh._sample._cache_size() == earlier + 2


def test_prompts(served):
    with pytest.raises(ValueError, match="the request must contain a prompt"):
        served.prepare(request(served.spec, prompt=None), (0, 0))
    with pytest.raises(ValueError, match="offline tokenizer supports only ASCII"):
        served.prepare(request(served.spec, prompt="鼠"), (0, 0))
    single = compiled({"base": make_policy(instructions=("open the pot",))})
    default = compiled({"base": make_policy()}, prompt="open the pot")
    expected = served.prepare(request(served.spec, prompt="open the pot"), (0, 0)).ids
    for policies in (single, default):
        found = policies.prepare(request(served.spec, prompt=None), (0, 0)).ids
        np.testing.assert_array_equal(found, expected)


def test_specs():
    assert spec_of(make_policy()).cameras == ("side", "wrist")
    renamed = spec_of(make_policy(cameras={"side": "front"}))
    assert (renamed.cameras, renamed.state_dim, renamed.chunk) == (("front",), 7, 4)
    with pytest.raises(ValueError, match="a and b cannot be served together: their cameras"):
        compiled({"a": make_policy(), "b": make_policy(cameras={"side": "front"})})


def test_batch_sizes():
    assert [batch_sizes(n) for n in (1, 2, 5, 8)] == [(1,), (1, 2), (1, 2, 4, 5), (1, 2, 4, 8)]
    with pytest.raises(ValueError, match="must be at least 1, got 0"):
        batch_sizes(0)


def test_a_prompt_table_for_other_instructions_is_the_same_as_a_new_one():
    for config in (Pi0Config.dummy(), dataclasses.replace(Pi0Config.dummy(), inputs=OPENPI)):
        table = PromptTable.of(WORDS, INSTRUCTIONS, config, num_joints=6)
        other = table.with_instructions(WORDS, ["lift the lid"])
        expected = PromptTable.of(WORDS, ["lift the lid"], config, num_joints=6)
        assert other.instructions == expected.instructions
        for a, b in zip(jax.tree.leaves(other), jax.tree.leaves(expected), strict=True):
            np.testing.assert_array_equal(a, b)
