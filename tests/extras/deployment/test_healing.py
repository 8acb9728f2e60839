"""Healing trains the adapters of a form on the run's data and nothing else."""

import dataclasses
import shutil

import jax
import numpy as np
import pytest

from envs.datasets import rlds
from lorasp_jax.adapters import adaptation
from lorasp_jax.data import cache
from lorasp_jax.data.opening import open_source
from lorasp_jax.extras.deployment import __main__ as command
from lorasp_jax.extras.deployment import healing, measurement, variants
from lorasp_jax.extras.serving import loading
from lorasp_jax.extras.study import held_out
from lorasp_jax.models.smolvla import SmolVLAConfig
from lorasp_jax.training import demonstrations, export
from lorasp_jax.training.finished_run import recorded_config
from lorasp_jax.training.run_folder import read_json, to_json, write_json
from tests.cases import mostly_slow
from tests.extras.deployment.test_deployment import EPISODES, RANK, actions, finished_run, refuse
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, leaves, make_run, random_episodes
from tests.studies.paper.updates import add_noise

OWN = {"press": random_episodes("press", 1)}
"""What the run has learned from; `EPISODES` calibrate."""


@pytest.fixture(scope="module")
def run(tmp_path_factory, dummy_base):
    """A run with its demonstrations, which trained fast and averaged."""
    folder = finished_run(tmp_path_factory.mktemp("runs") / "trained", dummy_base)
    OWN["press"].save(folder / "cache/press.npz")
    config = recorded_config(folder)
    optim = dataclasses.replace(config.optim, learning_rate=0.03, ema=0.999)
    write_json(folder / "config.json", to_json(dataclasses.replace(config, optim=optim)))
    return folder


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(variants, "BATCHES", 1)
    monkeypatch.setattr(measurement, "BATCHES", 1)
    monkeypatch.setattr(held_out, "demonstrations", lambda config, *_: EPISODES)


def other_backbone(run):
    config = dataclasses.replace(recorded_config(run), targets=CONFIG.targets)
    policy = make_run(run.parent / "other", config, random_backbone(SmolVLAConfig.dummy())).policy
    return dataclasses.replace(policy, model=add_noise(policy.model, 0.1))


@pytest.mark.parametrize(
    "load", mostly_slow([export.load_policy, other_backbone], [export.load_policy])
)
def test_adapters_alone_learn_what_the_run_learned(run, load):
    files = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    half = variants.in_form(load(run), "half", EPISODES)
    before = leaves(jax.tree.map(np.array, adaptation.split(half.model)[1]))
    healed = healing.heal(half, run, 12)
    assert {method.rank for method in adaptation.methods(healed.model).values()} == {RANK // 2}
    (_, old, base), (_, new, same) = (adaptation.split(x.model) for x in (half, healed))
    assert all((x == before[name]).all() for name, x in leaves(old).items())  # not modified
    assert all((x != before[name]).any() for name, x in leaves(new).items())
    assert all((x == leaves(base)[name]).all() for name, x in leaves(same).items())
    losses = [measurement.mean_loss(policy, OWN) for policy in (half, healed)]
    assert losses[1] < 0.9 * losses[0], losses
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == files


def test_the_optimizer_is_the_runs_but_slower(run):
    optim = recorded_config(run).optim
    data = dataclasses.replace(recorded_config(run).data, fresh_every=50)
    config = dataclasses.replace(recorded_config(run), data=data, log_every=50)
    found = healing._config(config, 40)
    assert (found.optim.steps, found.optim.warmup_steps, found.optim.ema) == (40, 1, 0)
    assert found.optim.learning_rate == pytest.approx(0.2 * 0.03)
    assert found.optim.final_learning_rate == optim.final_learning_rate
    assert (found.optim.batch_size, found.data.fresh_every) == (optim.batch_size, 0)
    assert healing._config(config, 5).optim.warmup_steps == 0
    slow = dataclasses.replace(config, optim=dataclasses.replace(optim, learning_rate=1e-5))
    assert healing._config(slow, 5).optim.final_learning_rate == pytest.approx(2e-6)


@pytest.mark.parametrize("name", mostly_slow(["merged-bf16", "half-nf4"], ["merged-bf16"]))
def test_a_healed_variant_is_saved_and_served(run, tmp_path, capsys, monkeypatch, name):
    made, out, (form, base) = [], tmp_path / "policy", name.split("-")

    def write(folder, policy, source, **options):
        made.append(policy)
        export_variant(folder, policy, source, **options)

    export_variant = export.write_variant
    monkeypatch.setattr(export, "write_variant", write)
    arguments = [str(run), "--save", name, "--out", str(out), "--heal", "2"]
    assert command.main(arguments) == 0
    assert capsys.readouterr().out.startswith(f"written: {out}, calibrated on ")
    assert export.describe(out)["healed"] == 2
    served = loading.load_run(str(out)).policy
    assert bool(adaptation.methods(served.model)) == (form != "merged")
    expected = actions(variants.on_base(made[0], base))
    np.testing.assert_allclose(actions(served), expected, atol=1e-5)
    unhealed = variants.transform(name, export.load_policy(run), EPISODES)
    assert np.abs(expected - actions(unhealed)).max() > 1e-4


@pytest.mark.slow
def test_a_run_of_a_dataset_is_healed_on_it(run, tmp_path):
    where = tmp_path / "recorded"
    rlds.write(OWN["press"], tmp_path / "rlds")
    cache.write([open_source(tmp_path / "rlds")], where, lambda *_: None)
    changed = shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("cache"))
    config = recorded_config(changed)
    data = dataclasses.replace(config.data, source=(str(where),), validation=("0",))
    write_json(changed / "config.json", to_json(dataclasses.replace(config, data=data)))
    whole = variants.in_form(export.load_policy(changed), "whole", EPISODES)
    healed = healing.heal(whole, changed, 12)
    losses = [measurement.mean_loss(policy, OWN) for policy in (whole, healed)]
    assert losses[1] < 0.9 * losses[0], losses
    shutil.rmtree(where)
    with pytest.raises(ValueError, match="recorded does not exist"):
        healing.heal(whole, changed, 12)


def test_missing_demonstrations_are_not_collected(run, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(demonstrations, "_collect", lambda *_: OWN["press"])
    changed, results = shutil.copytree(run, tmp_path / "run"), read_json(run / "results.json")
    tasks = dict.fromkeys(("press", "pour"), results["tasks"]["press"])
    write_json(changed / "results.json", results | {"tasks": tasks})
    files, out = {path: path.stat().st_mtime_ns for path in changed.rglob("*")}, tmp_path / "policy"
    error = refuse(capsys, changed, "--save", "half-bf16", "--out", out, "--heal", 1)
    assert "run cannot be healed: some of its demonstrations are gone" in error
    assert f"gone from {changed / 'cache'}: put them back, or leave out --heal" in error
    with pytest.raises(ValueError, match="some of its demonstrations are gone"):
        healing.heal(export.load_policy(run), changed, 1)
    assert {path: path.stat().st_mtime_ns for path in changed.rglob("*")} == files
    assert not out.exists()


def test_demonstrations_must_be_those_of_the_policy(run, tmp_path):
    cell = shutil.copytree(run, tmp_path / "cell", ignore=shutil.ignore_patterns("cache"))
    with pytest.raises(ValueError, match="cell cannot be healed: some of its demonstrations are"):
        healing.check(cell)
    other = dataclasses.replace(OWN["press"], instructions=("press", "push"))
    other.save(cell / "cache/press.npz")
    with pytest.raises(ValueError, match="the policy has no prompt for 'press'"):
        healing.heal(export.load_policy(cell), cell, 1)


def test_refusals(run, tmp_path, capsys):
    out = tmp_path / "policy"
    save = ("--save", "half-bf16", "--out", out)
    alone = refuse(capsys, run, "--heal", 2)
    assert "--heal changes what --save writes: add --save and --out" in alone
    for steps in (0, -1):
        error = refuse(capsys, run, *save, "--heal", steps)
        assert f"--heal must be at least 1 step, got {steps}" in error
    config = read_json(run / "config.json")
    data = config["data"] | {"source": "recorded"}
    for changes, reason in (
        ({"online": {}}, "cannot be healed: it has learned from its own success, not from data"),
        ({"distill": {}}, "it is distilled to few flow steps, which its data do not teach"),
        ({"protect": "runs/a"}, "its protected directions would not stay"),
        ({"adapt": ["vision=ada_lora", "action=lora_sp"]}, "ada_lora has spent its rank budget"),
        ({"data": data, "learn": "recap"}, "which actions are good (--learn recap)"),
    ):
        changed = shutil.copytree(run, tmp_path / "changed", dirs_exist_ok=True)
        write_json(changed / "config.json", config | changes)
        assert reason in refuse(capsys, changed, *save, "--heal", 1)
    assert not out.exists()
