"""Directions that a finished run uses keep every bit while a later run trains the others."""

import dataclasses
import io
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from rich.console import Console

from lorasp_jax.adapters import adaptation
from lorasp_jax.cli.train import _resolved
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig
from lorasp_jax.peft import LoRA, LoRASP, LoRASPRelease
from lorasp_jax.training import early, export, loop, program, protect, setup
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.export import load_policy
from lorasp_jax.training.overrides import parse
from lorasp_jax.training.run_folder import to_json, write_json
from tests import ROOT
from tests.models.random_models import random_backbone, with_noise
from tests.runs import (
    CONFIG,
    PROGRAMS,
    RESULTS,
    Terminate,
    finish_with_weights,
    leaves,
    make_run,
    random_episodes,
)
from tests.training.test_early import Hall

OPTIM = dataclasses.replace(CONFIG.optim, weight_decay=0.5, learning_rate=0.01, accumulate=2)
PEFT = LoRASP(rank=8, hidden_width=8, energy_target=0.5)


def some(model, seed=0):
    """Protect half of the directions of each layer, all of one and none of another."""
    rng = np.random.default_rng(seed)
    found = {path: rng.random(x.shape) < 0.5 for path, x in protect._nothing(model).items()}
    first, *_, last = found
    return found | {first: found[first] | True, last: found[last] & False}


def protecting(folder, backbone=Pi0Config.dummy, devices=1):
    """A run on random adapters, of which some entries are -0, that protects some directions."""
    config = dataclasses.replace(CONFIG, optim=OPTIM)
    run = make_run(folder, config, random_backbone(backbone()), devices)
    run.programs = PROGRAMS
    graphdef, adapters, frozen = adaptation.split(run.policy.model)
    adapters = with_noise(adapters, 0.1)
    adapters = jax.tree.map(lambda x: np.where(np.arange(x.shape[-1]) % 3, x, -0.0), adapters)
    run.policy = dataclasses.replace(run.policy, model=nnx.merge(graphdef, adapters, frozen))
    run.fixed = protect.fixed(run.policy.model, some(run.policy.model))
    return run


def bits(run):
    return {name: x.view(np.int32) for name, x in leaves(run.split()[1]).items()}


def check_kept(before, after, fixed):
    """All fixed numbers keep every bit; of the others, those with a gradient change."""
    kept = {name: np.broadcast_to(x, before[name].shape) for name, x in leaves(fixed).items()}
    assert kept.keys() == before.keys() == after.keys()
    for name, stays in kept.items():
        np.testing.assert_array_equal(before[name][stays], after[name][stays], err_msg=name)
    moved = [np.mean(before[n][~kept[n]] != after[n][~kept[n]]) for n in kept if not kept[n].all()]
    assert len(moved) > 4
    assert np.mean(moved) > 0.9


@pytest.mark.parametrize("backbone", [Pi0Config.dummy, SmolVLAConfig.dummy])
def test_protected_numbers_keep_every_bit(tmp_path, backbone):
    """Also over weight decay, micro-batches, a restart, and several devices."""
    run = protecting(tmp_path / "whole", backbone)
    before = bits(run)
    loop.train(run)
    check_kept(before, whole := bits(run), run.fixed)
    if backbone is not Pi0Config.dummy:
        return
    halved = protecting(tmp_path / "halved", backbone)
    with pytest.raises(KeyboardInterrupt):
        loop.train(halved, [Terminate()])
    halved = protecting(tmp_path / "halved", backbone)
    loop.train(halved, resume=True)
    assert all((x == whole[name]).all() for name, x in bits(halved).items())
    several = protecting(tmp_path / "several", backbone, devices=2)
    loop.train(several)
    check_kept(before, bits(several), several.fixed)


def test_what_is_fixed_of_a_layer():
    rows = np.array([[True, False, True], [False, False, True]])
    for method, router in (
        (LoRASP(rank=3, hidden_width=2), {"w1", "b1"}),
        (LoRASP.paper(), {"w1"}),
    ):
        params, _ = method.init(jax.random.key(0), jnp.zeros((5, 4)))
        params = jax.tree.map(lambda x: jnp.stack([x, x]), params)
        fixed = protect._fixed(method, params, rows)
        assert {name for name, x in fixed["router"].items() if x.all()} == router
        assert fixed["bank"]["u"].tolist() == rows[..., None].tolist()
        for columns in (fixed["bank"]["v"], fixed["router"]["w2"]):
            assert columns.tolist() == rows[:, None].tolist()
    pruned = LoRASP(rank=2)  # the router still scores a direction that is gone
    params, _ = LoRASP(rank=3).init(jax.random.key(0), jnp.zeros((5, 4)))
    params = jax.tree.map(lambda x: jnp.stack([x, x]), params)
    assert protect._fixed(pruned, params, rows)["bank"]["u"].shape == (2, 2, 1)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return finish_with_weights(tmp_path_factory.mktemp("runs") / "a", PEFT)


@pytest.fixture
def settings(finished, monkeypatch):
    """The config of a run that protects the finished one, without simulation."""
    base = random_backbone(Pi0Config.dummy()), "hash of the base"
    monkeypatch.setattr(setup, "base_model", lambda *_, **__: base)
    monkeypatch.setattr(setup.envs, "make", lambda *_, **__: Hall(("press it",), max_steps=6))
    remat = "none", preflight.Memory(*6 * [0.0])
    monkeypatch.setattr(preflight, "choose_remat", lambda *_: remat)
    model = dataclasses.replace(CONFIG.model, checkpoint=str(finished.parent / "base"))
    evaluation = dataclasses.replace(CONFIG.evaluation, execute_steps=1)
    changes = {"tasks": ("pour",), "protect": str(finished), "name": "b", "peft": PEFT}
    return dataclasses.replace(CONFIG, model=model, evaluation=evaluation, **changes)


def collect(config, folder, progress):
    """Random episodes, of the start run as it has learned them."""
    found = {task: random_episodes(task, task == "pour") for task in config.tasks}
    if config.tasks == ("press",):
        return found
    return {
        task: dataclasses.replace(x, instructions=("press it",), instruction=0 * x.instruction)
        for task, x in found.items()
    }


def prepare(config, folder, collect=collect, **options):
    folder.mkdir(exist_ok=True)
    console = Console(file=io.StringIO(), width=200)
    options |= {"collect": collect}
    run = setup.prepare(config, folder, console, time.perf_counter(), **options)
    return run, console.file.getvalue()


def test_a_run_protects_what_another_uses(settings, finished, tmp_path, monkeypatch):
    monkeypatch.setattr(protect, "ROOM", 1.0)  # all banks count as full
    run, said = prepare(settings, tmp_path / "b")
    start = load_policy(finished)
    before = leaves(nnx.state(start.model, adaptation.AdapterParam))
    assert all((x == before[name]).all() for name, x in leaves(run.split()[1]).items())
    known, inputs = start.processor, run.policy.processor
    assert inputs.prompts.instructions == ("press it", *known.prompts.instructions)
    assert inputs.statistics.to_json() == known.statistics.to_json()
    protected = protect.read(tmp_path / "b", run.policy.model)
    assert {*protected} == {*adaptation.methods(run.policy.model)}
    assert 0 < np.concatenate([x.ravel() for x in protected.values()]).mean() < 1
    assert "free directions" in said
    assert "warning: only" in said

    def only_own(config, *rest):
        assert config.tasks == ("pour",), "it counts again"
        return collect(config, *rest)

    again, said = prepare(settings, tmp_path / "b", only_own)
    assert "free directions" not in said
    assert all((x == leaves(run.fixed)[name]).all() for name, x in leaves(again.fixed).items())

    first = bits(run)
    loop.train(run, [export.Export()])
    check_kept(first, bits(run), run.fixed)
    served = load_policy(tmp_path / "b")
    assert all(
        (x.view(np.int32) == bits(run)[name]).all()
        for name, x in leaves(adaptation.split(served.model)[1]).items()
    )

    write_json(tmp_path / "b/config.json", to_json(settings))
    write_json(tmp_path / "b/results.json", RESULTS)
    third = dataclasses.replace(settings, protect=str(tmp_path / "b"), name="c")
    chained, _ = prepare(third, tmp_path / "c")
    union = protect.read(tmp_path / "c", chained.policy.model)
    assert all((union[path] >= x).all() for path, x in protected.items())


def test_the_program_is_compiled_early(settings, tmp_path, monkeypatch):
    """Before the directions are known, on which it does not depend."""
    texts, jit_steps = [], program.jit_steps

    def recorded(*arguments):
        def lower(*shapes):
            texts.append(jitted.lower(*shapes).as_text())
            return SimpleNamespace(compile=lambda: pytest.skip("not needed"))

        jitted = jit_steps(*arguments)
        return SimpleNamespace(lower=lower)

    monkeypatch.setattr(program, "jit_steps", recorded)
    monkeypatch.setattr(loop, "jit_steps", recorded)
    lower = lambda run, built: early._lower(run, built, early.data_shapes(run, built)[1])  # noqa: E731
    run, _ = prepare(settings, tmp_path / "b", meanwhile=[lower])
    with pytest.raises(pytest.skip.Exception):
        loop.train(run)
    assert texts[0] == texts[1]
    assert len(texts) == 2
    graphdef, state = nnx.split(run.policy.model)  # a dry run has only shapes
    shapes = protect.fixed(nnx.merge(graphdef, jax.eval_shape(lambda: state)))
    assert jax.tree.map(np.shape, shapes) == jax.tree.map(np.shape, run.fixed)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robot": "panda"}, r"robot must be that of .*/a, whose .*: piper, got panda"),
        ({"peft": LoRASP(rank=4, hidden_width=8)}, r"peft\.rank must be that of .*: 8, got 4"),
        ({"peft": LoRASPRelease(rank=8)}, r"peft\.name must .*: lora_sp, got lora_sp_release"),
        ({"targets": ("q_proj",)}, "targets must be that of"),
        ({"optim": dataclasses.replace(CONFIG.optim, ema=0.9)}, "--optim.ema cannot be combined"),
        ({"protect": "missing"}, "there is no folder missing, .* leave a link in its place"),
        ({"protect": str(ROOT / "assets/pi0_nano")}, "pi0_nano is not a finished run"),
    ],
)
def test_bad_settings_are_refused_in_a_sentence(settings, changes, message):
    with pytest.raises(ValueError, match=message):
        protect.check(dataclasses.replace(settings, **changes))


def test_only_lora_sp_has_directions(settings, tmp_path):
    lora = finish_with_weights(tmp_path / "lora")
    with pytest.raises(ValueError, match="lora has lora adapters: only LoRA-SP's can be protected"):
        protect.check(dataclasses.replace(settings, protect=str(lora), peft=LoRA(rank=4)))


@pytest.mark.parametrize("free", [0, 3, 5])
def test_few_free_directions_are_told(tmp_path, free):
    rows = np.arange(100).reshape(2, 50) >= free
    console = Console(file=io.StringIO(), width=40)
    protect._warn_if_full(console, {"a": rows[:1], "b": rows[1:]})
    expected = f"warning: only {free}.0% of all directions are free" if free < 5 else ""
    assert console.file.getvalue().partition(" to learn")[0] == expected


def test_other_kinds_of_runs_refuse_it(finished):
    options = ["--config", str(ROOT / "configs/ppo.py"), "--scale", "smoke"]
    with pytest.raises(ValueError, match="--protect is not for"):
        _resolved(parse([*options, "--from", str(finished), "--protect", str(finished)]))


def test_damaged_directions_are_refused(tmp_path):
    write_json(tmp_path / protect.FILE, {"x": ["01"]})
    with pytest.raises(ValueError, match="it has x, which is no layer"):
        protect.read(tmp_path, nnx.Dict())
    text = (tmp_path / protect.FILE).read_text()
    (tmp_path / protect.FILE).write_text(text.replace("01", "11"))
    with pytest.raises(ValueError, match="the digest does not match"):
        protect.read(tmp_path, nnx.Dict())
