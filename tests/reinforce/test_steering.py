"""An actor of the noise: a bandit with a known answer, and what becomes of its run."""

import dataclasses
import re
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import lorasp_jax
from lorasp_jax import models
from lorasp_jax.adapters import adaptation
from lorasp_jax.cli.train import _resolved
from lorasp_jax.config import OptimConfig
from lorasp_jax.extras.deployment import variants
from lorasp_jax.extras.serving import exported, exporting, loading
from lorasp_jax.extras.serving.adapters import Bases
from lorasp_jax.extras.serving.policies import CompiledPolicy
from lorasp_jax.models.noise_actor import PATH, NoiseActor
from lorasp_jax.models.perceptron import moments
from lorasp_jax.models.smolvla import SmolVLAConfig
from lorasp_jax.reinforce import descent, loop, setting, start, steering
from lorasp_jax.reinforce.config import Learning
from lorasp_jax.reinforce.descent import Descent, Learned
from lorasp_jax.reinforce.surrogate import Samples
from lorasp_jax.training import export
from lorasp_jax.training.export import RecordedPolicy, load_policy
from lorasp_jax.training.overrides import parse
from lorasp_jax.training.run_folder import read_json, read_metrics, to_json, write_json
from tests import ROOT
from tests.extras.serving.test_policies import STEPS, noise_of, reference, request
from tests.models.random_models import random_backbone
from tests.reinforce import rooms
from tests.reinforce.rooms import outputs
from tests.runs import RESULTS, finish_with_weights, leaves, make_run

CALLS, STD, SLOTS = 512, 0.5, (True, True, False)
SETTINGS = Descent(learning_rate=3e-3, epochs=4, size=256, clip=0.2, max_kl=0.04)


def flow(state):
    """A flow of one step whose chunk is half of its noise and, in all actions, half of the state.

    With targets t, w = 2 t - state is the best.
    """
    return lambda x, _: (0.5 * x - 0.5 * state[:, None], {})


def bandit(key, actor, target):
    """Draw w in random states; return x, samples and rewards."""
    keys = jax.random.split(key, 3)
    state = jax.random.normal(keys[0], (CALLS, len(SLOTS)))
    velocity = flow(state)
    seen = actor.observe(velocity, SimpleNamespace(state=state), num_steps=1)
    np.testing.assert_allclose(seen[:, :3], state)
    mean = actor(seen)
    chosen = mean + STD * jax.random.normal(keys[1], mean.shape)
    noise = actor.mixed(chosen, jax.random.normal(keys[2], (CALLS, actor.chunk, len(SLOTS))))
    chunk = noise - velocity(noise, None)[0]
    error = jnp.square(chunk - target)[..., np.array(SLOTS)]
    rewards = -error.mean(1).sum(-1)
    advantages = (rewards - rewards.mean()) / rewards.std()
    samples = Samples(*(x[:, None] for x in (chosen, advantages, advantages == advantages, mean)))
    return seen, samples


def new_actor():
    config = SimpleNamespace(action_dim=len(SLOTS), chunk=4)
    actor = NoiseActor.init(jax.random.key(0), config, std=STD, widths=(64, 64))
    seen, samples = bandit(jax.random.key(7), actor, 0.0)
    mean, std = moments(seen, samples.valid[:, 0])
    return dataclasses.replace(
        actor, network=dataclasses.replace(actor.network, mean=mean, std=std)
    )


def learned(actor):
    return Learned(actor.network, descent.optimizer().init(actor.network.layers), jnp.ones(()))


def test_a_bandit_finds_the_best_noise():
    actor, target = new_actor(), jnp.array([0.3, -0.2, 0.0])
    state = learned(actor)
    for step in range(80):
        actor = dataclasses.replace(actor, network=state.network)
        seen, samples = bandit(jax.random.key(step), actor, target)
        key = jax.random.key(100 + step)
        state, rows, _ = steering._descend(state, seen, samples, key, SETTINGS, STD, SLOTS)
        np.testing.assert_allclose(rows["ratio"][0], 1, atol=1e-4)
    found = state.network(seen)
    best = 2 * target - seen[:, :3]
    error = jnp.abs(found - best)[:, np.array(SLOTS)]
    before = jnp.abs(best)[:, np.array(SLOTS)]
    assert error.mean() < 0.15 < 0.6 < before.mean()


def test_a_gradient_that_is_not_finite_is_not_followed():
    actor = new_actor()
    seen, samples = bandit(jax.random.key(0), actor, 0.0)
    samples = samples._replace(advantages=jnp.nan * samples.advantages)
    after, rows, _ = steering._descend(
        learned(actor), seen, samples, jax.random.key(1), SETTINGS, STD, SLOTS
    )
    assert not rows["taken"].any()
    assert jax.tree.all(jax.tree.map(jnp.array_equal, after.network, actor.network))


@pytest.mark.slow
def test_a_frozen_policy_succeeds_with_learned_noise(tmp_path, monkeypatch):
    monkeypatch.setattr(setting, "environment", lambda *_: rooms.Room(num_envs=64, goal=0.1))
    online = Learning(method="noise", worlds=64, std=STD, epochs=8, max_kl=0.04)
    optim = OptimConfig(steps=25, batch_size=64, learning_rate=1e-3)
    loop.train(rooms.start(tmp_path, rooms.config(online=online, optim=optim)))
    rates = [row["rollout/press"] for row in read_metrics(tmp_path)]
    assert np.mean(rates[:4]) < 0.3
    assert np.mean(rates[-4:]) > 0.7


def test_smolvla_learns_noise_too(tmp_path, monkeypatch):
    monkeypatch.setattr(setting, "environment", lambda *_: rooms.Room())
    changes = {"online": Learning(method="noise", worlds=8, std=STD, reward="dense")}
    model = dataclasses.replace(rooms.config().model, backbone="smolvla")
    config = rooms.config(**changes, model=model, targets=("q_proj",))
    run = make_run(tmp_path, config, random_backbone(SmolVLAConfig.dummy()))
    loop.train(run)
    rows = read_metrics(tmp_path)
    assert rows[-1]["updates"] > 0
    assert rows[1]["start_kl"] < rows[-1]["start_kl"]


@pytest.fixture(scope="module")
def few(tmp_path_factory):
    """A finished run with plain LoRA, whose base is saved beside it."""
    return finish_with_weights(tmp_path_factory.mktemp("runs") / "few")


def resolve(folder, *arguments, config="noise_space"):
    options = ["--config", str(ROOT / f"configs/{config}.py"), "--scale", "smoke"]
    options += ["--evaluation.execute-steps", "2", "--online.worlds", "8", "--from", str(folder)]
    return _resolved(parse([*options, *map(str, arguments)])).config


@pytest.fixture(scope="module")
def run(few, tmp_path_factory):
    """A finished run that has learned its noise."""
    folder = tmp_path_factory.mktemp("noise")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(setting, "environment", lambda *_: rooms.Room())
        config = resolve(few, "--online.reward", "dense", "--optim.batch-size", 8)
        run = start.load(config, folder, Console(quiet=True), 0.0)
        run.devices = jax.devices()[:1]
        loop.train(run, [start.PolicyExport()])
    write_json(folder / "config.json", to_json(config))
    write_json(folder / "results.json", RESULTS)
    return run


def test_a_run_is_exported_with_its_actor(run, few):
    again = load_policy(run.folder)
    np.testing.assert_array_equal(outputs(again), outputs(run.policy))
    np.testing.assert_allclose(outputs(again.with_sampler()), outputs(again), atol=1e-5)
    assert np.abs(outputs(again) - outputs(load_policy(few))).max() > 1e-3


def test_only_the_actor_learns(run, few):
    network = run.policy.model.noise_actor.get_value().network
    assert run.parameters[0] == sum(x.size for x in jax.tree.leaves(network))
    before, after = (
        leaves(adaptation.split(policy.model)[1]) for policy in (load_policy(few), run.policy)
    )
    assert any(PATH in name for name in after.keys() - before.keys())
    for name, leaf in before.items():
        np.testing.assert_array_equal(after[name], leaf, err_msg=name)
    new = NoiseActor.init(
        setting.RandomStream.NOISE_ACTOR.key(run.config.seed),
        run.policy.model.config,
        std=run.config.online.std,
        widths=setting._WIDTHS,
    )
    first, now = new.network.layers[0][0], network.layers[0][0]
    assert 0 < np.abs(first - now).max() < 0.1
    assert np.all(network.std[:6] > 0)


def test_a_served_policy_has_its_actor(run):
    loaded = loading.load_run(str(run.folder))
    served = CompiledPolicy(loaded, num_steps=STEPS, max_batch=1)
    sent = request(served.description, prompt=served.instructions[0])
    noise = noise_of(served.description)
    row = {"images": sent.images, "state": sent.state, **served.tokens(sent.prompt)}
    row |= {"present": {name: np.True_ for name in sent.images}, "noise": np.asarray(noise[0])}
    found = served.run(jax.tree.map(lambda x: np.asarray(x)[None], row))[0]
    np.testing.assert_allclose(found, reference(run.policy, [sent], noise), atol=1e-5)


def test_an_exported_policy_has_its_actor(run, tmp_path):
    exporting.write(run.policy, tmp_path / "out", num_steps=STEPS, max_batch=1)
    loaded = exported.load(tmp_path / "out")
    sent = request(loaded.description, prompt=loaded.instructions[0])
    noise = noise_of(loaded.description)
    found = loaded.act(sent.images, sent.state, sent.prompt, noise=np.asarray(noise[0]))
    np.testing.assert_allclose(found, reference(run.policy, [sent], noise)[0], atol=1e-5)


def test_what_would_lose_the_actor_is_refused(run, few, capsys):
    folder = run.folder
    with pytest.raises(ValueError, match="has learned its initial noise: start from the run that"):
        resolve(folder)
    with pytest.raises(ValueError, match="has learned its initial noise: start from the run that"):
        resolve(folder, config="ppo")
    assert not Bases.can_share(str(folder))
    assert "has learned its noise, so it has a copy of its own" in capsys.readouterr().err
    with pytest.raises(ValueError, match="has learned its noise: serve it on its own"):
        Bases().sampler(RecordedPolicy.read(folder))
    with pytest.raises(ValueError, match="make variants of the run that it started from"):
        variants.check_run(folder)
    with pytest.raises(ValueError, match="has learned its initial noise: it has no variants"):
        export.write_variant(folder / "variant", run.policy, folder)
    with pytest.raises(ValueError, match=f"rule '\\^{PATH}\\$' applies to nothing"):
        lorasp_jax.load_adapters(folder, RecordedPolicy.read(few).load_base())
    with pytest.raises(ValueError, match=f"{PATH} is fully trained, but PEFT cannot store it"):
        lorasp_jax.save_peft(folder / "peft", run.policy.model, names=lambda *x: str(x))
    with pytest.raises(ValueError, match="a model that has not learned its initial noise"):
        models.save(folder / "merged", adaptation.merge(run.policy.model))
    with pytest.raises(ValueError, match="the policy has learned its initial noise"):
        setting.prepare(run)


def test_absurd_settings_in_a_file_are_refused(run, tmp_path):
    found = read_json(run.folder / "adapter.json")
    found["metadata"][PATH] = {"std": 0.5, "widths": [2**30]}
    write_json(tmp_path / "adapter.json", {k: v for k, v in found.items() if k != "digest"})
    with pytest.raises(ValueError, match=r"adapter.json does not describe a policy"):
        load_policy(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--online.std", 1], "online.std must be below 1 for noise, got 1.0"),
        (["--online.rounds", 2], "online.rounds is not for noise: drop it"),
        (["--online.correlation", 0.5], "online.correlation is not for noise: drop it"),
        (["--online.adapters", "merge"], "online.adapters is not for noise: drop it"),
        (["--optim.weight-decay", 0.1], "optim.weight_decay is not for noise: drop it"),
        (["--auxiliary.z", 0.1], "auxiliary is not for noise: drop it"),
        (["--optim.steps", 1], "optim.steps must be at least 2, got 1: the first iteration"),
        (["--from", ""], "online.method noise needs a finished run: name it with --from"),
    ],
)
def test_bad_input_is_refused_in_a_sentence(few, arguments, message, capsys):
    with pytest.raises((ValueError, SystemExit)) as caught:
        resolve(few, *arguments)
    said = str(caught.value) + re.sub(r"[│\s]+", " ", capsys.readouterr().err)
    assert message in said, said


@pytest.mark.parametrize("scale", ["smoke", "cpu", "accelerator"])
def test_the_config_can_start(few, scale):
    assert resolve(few, "--scale", scale).online.method == "noise"
