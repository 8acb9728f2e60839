"""A run whose adapters start from the demonstrations."""

import dataclasses
import io
import time

import jax
import numpy as np
import pytest
from flax import nnx
from rich.console import Console

from lorasp_jax import adaptation, paths
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.tokenizer import Offline
from lorasp_jax.peft import LoRA
from lorasp_jax.training import setup
from lorasp_jax.training.overrides import override
from tests.runs import CONFIG, random_episodes

TARGETS = ("patch_embed", "language.*q_proj", "action_out_proj")


@pytest.fixture
def config(monkeypatch):
    """No simulation, and the dummy backbone."""
    monkeypatch.setattr(setup.envs, "make", lambda *_, **__: None)
    monkeypatch.setattr(setup, "base_model", lambda _: (Pi0Config.dummy().create(nnx.Rngs(0)), ""))
    monkeypatch.setattr(
        setup, "_collect", lambda run: {t: random_episodes(t, 0) for t in run.config.tasks}
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


def test_eva_of_the_command_line_sees_the_demonstrations(config, tmp_path):
    run = setup.prepare(config, tmp_path, Console(file=io.StringIO()), time.perf_counter())
    found = adaptation.methods(run.policy.model)
    assert {method.initialization for method in found.values()} == {"eva"}
    base = Pi0Config.dummy().create(nnx.Rngs(0))
    moments = setup.input_moments(run, base, run.policy.processor)
    assert set(moments) == set(found)
    assert len(found) == 3
    for path, parent, _, variable in paths.places(
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
    found = setup.processor([group], model, Offline(), relative=relative)
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
