"""A run whose adapters start from the demonstrations."""

import dataclasses
import io
import json
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from rich.console import Console

from lorasp_jax import models
from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.config import ModelConfig
from lorasp_jax.data.opening import open_source
from lorasp_jax.models import inputs
from lorasp_jax.models.checkpoints import loading
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import FullFineTuning, LoRA
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.tokenizer import Offline
from lorasp_jax.training import base, export, setup
from lorasp_jax.training.loop import train
from lorasp_jax.training.overrides import override
from lorasp_jax.training.run import Run
from tests import GOLDEN
from tests.data.lerobots import golden
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, leaves, random_episodes

BASE_MODEL = setup.base_model
TARGETS = ("patch_embed", "language.*q_proj", "action_out_proj")


def world(*instructions):
    return SimpleNamespace(instructions=instructions, robot=SimpleNamespace(num_joints=6))


@pytest.fixture
def config(monkeypatch):
    """No simulation, and the dummy backbone."""
    worlds = world(*random_episodes("", 0).instructions)
    monkeypatch.setattr(setup.envs, "make", lambda *_, **__: worlds)
    monkeypatch.setattr(
        setup, "base_model", lambda *_, **__: (random_backbone(Pi0Config.dummy()), "")
    )
    monkeypatch.setattr(
        setup, "demonstrations", lambda c, *_: {t: random_episodes(t, 0) for t in c.tasks}
    )
    config = dataclasses.replace(CONFIG, peft=LoRA(rank=4), targets=TARGETS)
    config = dataclasses.replace(
        config, evaluation=dataclasses.replace(config.evaluation, execute_steps=1)
    )
    return override(config, ["--peft.initialization", "eva"])


def test_targets_of_the_command_line_can_be_presets(config, tmp_path):
    plain = override(
        config, ["--targets", "language", "^vision/head", "--peft.initialization", "kaiming"]
    )
    printed = io.StringIO()
    run = setup.prepare(plain, tmp_path, Console(file=printed, width=200), time.perf_counter())
    found = adaptation.methods(run.policy.model)
    assert {path.rpartition("/")[0] for path in found} == {"language/blocks", "vision"}
    assert "; the others are frozen, all of action, action_in_proj," in printed.getvalue()


def test_a_tokenizer_of_another_model_is_found_before_anything_long(config, tmp_path, monkeypatch):
    """As are demonstrations that an older version of the tasks left."""
    console = Console(file=io.StringIO())
    smolvlm = GOLDEN / "tokenizers/smolvlm_like_tokenizer.json"
    other = override(config, ["--model.tokenizer", str(smolvlm)])
    with pytest.raises(ValueError, match="demonstrations of other instructions"):
        setup._collect(Run(config, tmp_path, console, "", 0), ["press the red button"])
    monkeypatch.setattr(setup, "demonstrations", lambda *_: pytest.fail("it began"))
    with pytest.raises(ValueError, match="beyond the backbone's vocabulary of 320: the token"):
        setup.prepare(other, tmp_path, console, time.perf_counter())


def test_policies_of_lerobot_are_fed_as_they_say(config, tmp_path, monkeypatch):
    fields = {
        "type": "pi0",
        "normalization_mapping": {"STATE": "QUANTILE10", "ACTION": "MIN_MAX"},
        "use_relative_actions": True,
        "action_feature_names": ["a", "b", "gripper"],
        "output_features": {"action": {"shape": [3]}},
    }
    (tmp_path / "config.json").write_text(json.dumps(fields))
    weightless = lambda _, wanted: SimpleNamespace(config=wanted)  # noqa: E731
    monkeypatch.setattr(loading.ModelFolder, "load", weightless)
    monkeypatch.setattr(models, "weights_hash", lambda _: "")
    model = ModelConfig(size="base", checkpoint=str(tmp_path))
    wanted = dataclasses.replace(
        inputs.LEROBOT_PI0, state="quantile10", action="min_max", delta=(True, True, False)
    )
    found, _ = BASE_MODEL(dataclasses.replace(config, model=model))
    assert found.config.inputs == wanted
    (tmp_path / "config.json").unlink()
    found, _ = BASE_MODEL(dataclasses.replace(config, model=model))
    assert found.config.inputs == inputs.OPENPI
    two_arms = dataclasses.replace(inputs.OURS, delta=(True,) * 14)
    found = random_backbone(dataclasses.replace(Pi0Config.dummy(), inputs=two_arms))
    monkeypatch.setattr(setup, "base_model", lambda *_, **__: (found, ""))
    with pytest.raises(ValueError, match="has 14 entries, but the robot's actions have 7"):
        setup.prepare(config, tmp_path, Console(file=io.StringIO()), time.perf_counter())


def test_straight_line_code_is_chosen_on_the_command_line(monkeypatch):
    monkeypatch.setattr(base, "SIZES", ("dummy",))
    monkeypatch.setattr(Pi0Config, "create", lambda config, _: config)
    monkeypatch.setattr(base.models, "weights_hash", lambda _: "")
    unroll = lambda *words: BASE_MODEL(override(CONFIG, [*words]))[0].unroll  # noqa: E731
    assert not unroll()
    assert unroll("--model.unroll", "True")


@pytest.mark.slow
def test_a_pi05_of_the_command_line_trains_and_acts(config, tmp_path, monkeypatch):
    """And its base, trained in full, loads again; prompts with another state are others."""
    monkeypatch.setattr(setup, "base_model", BASE_MODEL)
    config = dataclasses.replace(config, peft=FullFineTuning(), model=ModelConfig(checkpoint=""))
    config = override(config, ["--model.size", "nano_pi05", "--optim.steps", "2"])
    run = setup.prepare(config, tmp_path, Console(file=io.StringIO()), time.perf_counter())
    run.devices = jax.devices()[:1]
    before = leaves(nnx.state(run.policy.model))
    train(run)
    after = leaves(nnx.state(run.policy.model))
    assert any((after[name] != array).any() for name, array in before.items())
    group = next(iter(run.episodes.values()))
    raw = {
        "image": {name: jnp.asarray(image[:, 0]) for name, image in group.image.items()},
        "state": jnp.asarray(group.state[:, 0]),
    }
    tokens = run.policy.processor.encode(raw, jnp.zeros(3, int)).tokens
    assert (tokens[0] != tokens[1]).any()
    sample = jax.jit(Policy.sample)
    actions = sample(run.policy, jax.random.key(0), raw, jnp.zeros(3, int))
    assert jnp.isfinite(actions).all()
    export.write(run)
    model = models.load(tmp_path / "base")
    assert (model.config.pi05, model.config.inputs) == (True, inputs.OURS_PI05)
    again = sample(Policy(model, run.policy.processor), jax.random.key(0), raw, jnp.zeros(3, int))
    np.testing.assert_allclose(again, actions, atol=0.05)  # the file is bf16


@pytest.mark.slow
def test_eva_of_the_command_line_sees_the_demonstrations(config, tmp_path):
    run = setup.prepare(config, tmp_path, Console(file=io.StringIO()), time.perf_counter())
    found = adaptation.methods(run.policy.model)
    assert {method.initialization for method in found.values()} == {"eva"}
    base = random_backbone(Pi0Config.dummy())
    moments = setup.input_moments(run, base, run.policy.processor)
    assert set(moments) == set(found)
    assert len(found) == 3
    for path, parent, _, variable in paths.locate(
        nnx.List([run.policy.model]), adaptation.AdapterParam
    ):
        a = np.float64(variable.get_value()["lora_a"])
        moment = np.float64(moments[path.rpartition("/")[0]])
        captured = np.einsum("...ir,...ij,...jr->...", a, moment, a)
        best = np.linalg.eigvalsh(moment)[..., -4:].sum(-1)
        np.testing.assert_allclose(captured, best, rtol=1e-3)  # no 4 directions hold more
        assert (captured > 0).all()
        assert parent.method == LoRA(rank=4, initialization="eva")


def test_eva_sees_a_dataset_that_streams(config, tmp_path):
    run = setup.prepare(config, tmp_path, Console(file=io.StringIO()), time.perf_counter())
    table = run.policy.processor
    on_device = setup._drawing(run, table, 4)(jax.random.key(0))
    run.dataset, run.streams = jax.tree.map(np.asarray, run.steps), True
    draw = setup._drawing(run, table, 4)
    first, second = draw(jax.random.key(0)), draw(jax.random.key(0))
    assert jax.tree.map(np.shape, first) == jax.tree.map(np.shape, on_device)
    assert (first.actions != second.actions).any()


@pytest.mark.parametrize("relative", [False, True])
def test_actions_are_normalised_as_they_are_learned(relative):
    """Over all windows as training draws them, mean 0 and standard deviation 1."""
    group, model = random_episodes("press", 0), Pi0Config.dummy()
    prompts = PromptTable.of(Offline(), group.instructions, model, num_joints=6)
    found = setup.processor([group], model, prompts, relative=relative)
    states, chunks = [], []
    for episode in range(3):
        end = group.length[episode] - 1
        for step in range(end + 1):
            states.append(group.state[episode, step])
            chunks.append(group.action[episode, np.minimum(step + np.arange(model.chunk), end)])
    state, chunk = np.stack(states), np.stack(chunks)
    learned = found.normalize_actions(chunk, state)[..., found.slot_mask]
    looked_at = learned if relative else learned[:, :1]
    np.testing.assert_allclose(looked_at.mean(axis=(0, 1)), 0, atol=1e-5)
    np.testing.assert_allclose(looked_at.std(axis=(0, 1)), 1, atol=1e-4)
    np.testing.assert_allclose(
        found.decode(found.normalize_actions(chunk, state), state), chunk, atol=1e-5
    )
    if relative:  # the first action of a chunk, less its state; the gripper stays absolute
        moved = chunk - np.append(np.ones(6), 0) * state[:, None]
        expected = (moved - moved.mean(axis=(0, 1))) / moved.std(axis=(0, 1))
        np.testing.assert_allclose(learned, expected, atol=1e-4)


def test_a_dataset_whose_words_are_too_many_is_refused():
    words, model = Offline(), dataclasses.replace(Pi0Config.nano(), max_tokens=10)
    source = open_source(golden("v3"))
    fits = dataclasses.replace(model, max_tokens=11)
    prompts, joints = setup._told(source, [], words, fits)
    assert prompts.instructions == source.episode(0, ()).instructions
    assert joints == source.episode(0, ()).state.shape[-1] - 1
    with pytest.raises(ValueError, match=r"--model\.max-tokens: 'pick up .*' has 11 tokens"):
        setup._told(source, [], words, model)
