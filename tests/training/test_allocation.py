"""Plans of ranks from finished runs, and runs with a plan."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax import models
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import hugging_face
from lorasp_jax.cli import allocate, train
from lorasp_jax.config import ModelConfig
from lorasp_jax.evaluation.callback import NoEvaluation
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig
from lorasp_jax.peft import DoRA, LoRA, plan
from lorasp_jax.peft.plan import RankPlan
from lorasp_jax.report.html import write_report
from lorasp_jax.training import allocation, export, loop, rules
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.finished_run import recorded_config
from lorasp_jax.training.overrides import Command, override, parse
from lorasp_jax.training.run_folder import open_run, read_json, to_json, write_json
from tests import ROOT
from tests.models.random_models import random_backbone
from tests.peft.test_plan import parameters
from tests.runs import CONFIG, RESULTS, Terminate, finish_with_weights, leaves, make_run

DUMMIES = {"pi0": Pi0Config.dummy(), "smolvla": SmolVLAConfig.dummy()}


def base_shapes(backbone, targets=CONFIG.targets):
    return rules.shapes(nnx.eval_shape(lambda: DUMMIES[backbone].create(nnx.Rngs(0))), targets)


def random_plan(backbone, seed=0):
    """Ranks from 0 to 4 by layer; a stack without any."""
    rng, found = np.random.default_rng(seed), {}
    for path, (layers, d_in, d_out) in base_shapes(backbone).items():
        found[path] = tuple(rng.integers(0, min(5, d_in, d_out), layers).tolist())
    return RankPlan(backbone, found | {path: (0,) * len(found[path]) for path in [min(found)]})


def configured(backbone="pi0", method=None, **changes):
    model = ModelConfig(backbone=backbone, size="dummy", checkpoint="")
    changes = {"plan": random_plan(backbone), "model": model} | changes
    return dataclasses.replace(CONFIG, peft=method or LoRA(rank=4), **changes)


@pytest.mark.parametrize("backbone", DUMMIES)
def test_a_run_adapts_by_its_plan(backbone):
    config = configured(backbone)
    rules.check_plan(config, nnx.eval_shape(lambda: DUMMIES[backbone].create(nnx.Rngs(0))))
    model = preflight.abstract_model(config, DUMMIES[backbone])
    found = {path: method.ranks for path, method in adaptation.methods(model).items()}
    assert found == {path: ranks for path, ranks in config.plan.ranks.items() if any(ranks)}
    planned = parameters(config.plan.ranks, base_shapes(backbone))
    assert adaptation.count(model).trainable == planned > 0


def test_a_plan_is_part_of_the_config(tmp_path):
    config = configured()
    assert override(config, ["--seed", "3"]) == dataclasses.replace(config, seed=3)
    assert "plan" not in to_json(CONFIG)
    assert "ranks" not in to_json(configured(plan=None))["peft"]
    with open_run(config, tmp_path, resume=False):
        pass
    changed = dataclasses.replace(config, plan=random_plan("pi0", 1))
    with (
        pytest.raises(ValueError, match=r"different settings \(plan\.ranks\..*use another --name"),
        open_run(changed, tmp_path, resume=True),
    ):
        pass


def test_a_run_resumes_without_the_file_of_its_plan(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = configured()
    with open_run(config, train.RUNS, resume=False):
        pass
    bare = dataclasses.replace(config, plan=None)
    assert train._with_plan(Command(bare, resume=True)).config == config
    assert train._with_plan(Command(bare)).config == bare
    other = dataclasses.replace(config, plan=random_plan("pi0", 1))
    assert train._with_plan(Command(other, resume=True)).config == other


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": CONFIG.peft}, "a plan is for lora or dora, not for lora_sp"),
        ({"method": LoRA(rank=4, ranks=(1, 4))}, "peft.ranks are those of a plan"),
        ({"adapt": ("language=lora",)}, "plan and adapt cannot be combined"),
        ({"plan": random_plan("smolvla")}, "must be the plan's, smolvla, got pi0"),
        ({"method": DoRA(rank=4)}, "dora needs ranks of at least 1 or only 0"),
    ],
)
def test_configs_that_cannot_have_a_plan(changes, message):
    with pytest.raises(ValueError, match=message):
        configured(**changes)


def test_the_command_line_takes_ranks_from_one_place(tmp_path):
    random_plan("pi0").save(tmp_path / "plan.json")
    options = ["--config", str(ROOT / "configs/multitask.py"), "--scale", "smoke"]
    options += ["--method", "lora", "--plan", str(tmp_path / "plan.json")]
    assert parse(options).config.plan == random_plan("pi0")
    for text in (["--peft.rank", "16"], ["--peft.rank=16"]):
        with pytest.raises(ValueError, match=r"--peft\.rank and --plan, .* cannot be combined"):
            parse([*options, *text])


def test_plans_for_other_targets():
    config = configured(targets=("q_proj",))
    model = nnx.eval_shape(lambda: DUMMIES["pi0"].create(nnx.Rngs(0)))
    with pytest.raises(ValueError, match="none of the 3 layers to adapt, such as action/blocks/q"):
        rules.check_plan(config, model)
    with pytest.raises(ValueError, match=r"the plan lacks .*, one of the 27 layers"):
        rules.check_plan(configured(targets=(".*",)), model)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder with a LoRA-SP run, not simulated, and its base."""
    folder = tmp_path_factory.mktemp("runs")
    models.save(folder / "base", random_backbone(Pi0Config.dummy()))
    model = ModelConfig(size="dummy", checkpoint=str(folder / "base"))
    config = dataclasses.replace(CONFIG, model=model, tasks=("press",))
    run = run_on(folder / "sp", config)
    shapes = base_shapes("pi0")
    rng = np.random.default_rng(0)
    run.layer_ranks = {
        f"active_rank/{rules.tower(path)}/{rules.short_name(path)}": rng.uniform(1, 8, layers)
        for path, (layers, _, _) in shapes.items()
    }
    finish(run)
    return folder


def run_on(folder, config):
    run = make_run(folder, config, models.load(config.model.checkpoint))
    run.base_hash = models.weights_hash(config.model.checkpoint)
    write_json(folder / "config.json", to_json(config))
    return run


def finish(run):
    export.write(run)
    NoEvaluation().on_end(run)


def test_a_plan_follows_active_ranks(finished):
    ranks = read_json(finished / "sp" / "results.json")["layer_active_rank"]
    shapes = base_shapes("pi0")
    found = allocation.from_run(finished / "sp", rank=3)
    found.check(shapes)
    budget = 3 * sum(layers * (d_in + d_out) for layers, d_in, d_out in shapes.values())
    assert found.budget == budget
    assert 0 <= budget - parameters(found.ranks, shapes) < max(i + o for _, i, o in shapes.values())
    planned = np.concatenate([*found.ranks.values()])
    active = [ranks[rules.tower(path)][rules.short_name(path)] for path in found.ranks]
    assert np.corrcoef(planned, np.concatenate(active))[0, 1] > 0.9
    assert found.backbone == "pi0"
    assert found.source.startswith("sp ")
    default = allocation.from_run(finished / "sp")
    mean = read_json(finished / "sp" / "results.json")["active_rank"]["mean"]
    assert default.budget == int(mean * budget / 3)
    dropped = allocation.from_run(finished / "sp", rank=3, drop=2)
    assert [rank for each in dropped.ranks.values() for rank in each].count(0) == 2


def test_the_command(finished, tmp_path, capsys):
    out = tmp_path / "new" / "plan.json"
    arguments = [str(finished / "sp"), "--out", str(out)]
    assert allocate.main([*arguments, "--rank", "2", "--drop", "1"]) == 0
    assert plan.read(out) == allocation.from_run(finished / "sp", rank=2, drop=1)
    said, made = capsys.readouterr().out, plan.read(out)
    assert f"written: {out}, ranks from 0 to " in said
    count = parameters(made.ranks, base_shapes("pi0"))
    assert f", {count:,} of at most {made.budget:,} parameters" in said
    assert allocate.main(arguments) == 2
    assert "exists already: choose another --out" in capsys.readouterr().err
    out.unlink()
    assert allocate.main([*arguments, "--drop", "0"]) == 0
    out.unlink()
    assert allocate.main([*arguments, "--drop", "-1"]) == 2
    assert "drop must be at least 0" in capsys.readouterr().err


def test_runs_without_a_plan(finished, tmp_path):
    for rank, message in ((0.5, "is too small for ranks of at least 1"), (9, "run's 8, got 9")):
        with pytest.raises(ValueError, match=message):
            allocation.from_run(finished / "sp", rank=rank)
    shutil.copytree(finished / "sp", tmp_path / "old")
    write_json(tmp_path / "old" / "results.json", RESULTS | {"layer_active_rank": {}})
    with pytest.raises(ValueError, match="has no active ranks of"):
        allocation.from_run(tmp_path / "old")
    with pytest.raises(ValueError, match="was trained with lora: a plan is made from the active"):
        allocation.from_run(finish_with_weights(tmp_path / "lora"))
    (tmp_path / "old" / "results.json").unlink()  # as in a saved form
    with pytest.raises(ValueError, match=r"old is not a finished run: it needs results\.json"):
        allocation.from_run(tmp_path / "old")
    with pytest.raises(ValueError, match="there is no folder"):
        allocation.from_run(tmp_path / "nothing")


@pytest.fixture(scope="module")
def trained(finished):
    """Runs with a plan, with weight decay and dropout: one at once, one resumed."""
    config = read_json(finished / "sp" / "config.json")["model"]["checkpoint"]
    model = ModelConfig(size="dummy", checkpoint=config)
    optim = dataclasses.replace(CONFIG.optim, steps=3, weight_decay=0.1, ema=0.9)
    method = LoRA(rank=4, dropout=0.1)
    config = configured(
        method=method,
        model=model,
        optim=optim,
        tasks=("press",),
        log_every=1,
        targets=CONFIG.targets,
    )
    whole, halved = (run_on(finished / name, config) for name in ("whole", "planned"))
    loop.train(whole)
    with pytest.raises(KeyboardInterrupt):
        loop.train(halved, [Terminate()])
    resumed = run_on(finished / "planned", config)  # as in a new process
    loop.train(resumed, resume=True)
    finish(resumed)
    return whole, resumed


@pytest.mark.slow
def test_a_planned_run_from_start_to_export(trained, tmp_path):
    whole, run = trained
    expected = leaves(adaptation.split(whole.policy.model)[1])
    for name, value in leaves(adaptation.split(run.policy.model)[1]).items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)
    config = run.config
    assert config.plan
    loaded = export.load_policy(run.folder).model
    methods = adaptation.methods(loaded)
    for path, ranks in config.plan.ranks.items():
        if not any(ranks):
            assert path not in methods
            continue
        assert methods[path].ranks == ranks
        layer = nnx.state(loaded)
        for part in path.split("/"):
            layer = layer[part]
        values = {k: np.asarray(v) for k, v in layer["adapter"].get_value().items()}
        a, b = (values[n].reshape(-1, *values[n].shape[-2:]) for n in ("lora_a", "lora_b"))
        for i, rank in enumerate(ranks):
            assert not a[i, :, rank:].view(np.uint32).any()
            assert not b[i, rank:].view(np.uint32).any()
            assert a[i, :, :rank].all()
            assert b[i, :rank].any() or not rank
    planned = parameters(config.plan.ranks, base_shapes("pi0"))
    results = read_json(run.folder / "results.json")
    assert results["trainable_parameters"] == planned == adaptation.count(loaded).trainable
    total = adaptation.count(lorasp_jax.merge(loaded)).total
    assert results["total_parameters"] == total + planned
    means = [np.mean(ranks) for ranks in config.plan.ranks.values() if any(ranks)]
    found = [np.mean(x) for each in results["layer_active_rank"].values() for x in each.values()]
    np.testing.assert_allclose(sorted(found), sorted(means), rtol=1e-5)
    assert recorded_config(run.folder, simulated=False) == config
    assert "active rank in training" in write_report(run.folder).read_text()
    names = lambda path, index: ".".join([path.replace("/", "."), *map(str, index)])  # noqa: E731
    hugging_face.save_peft(tmp_path, loaded, names=names)
    stored = json.loads((tmp_path / hugging_face.CONFIG).read_text())
    live = sum(rank > 0 for ranks in config.plan.ranks.values() for rank in ranks)
    assert len(stored["target_modules"]) == live
    again = hugging_face.load_peft(tmp_path, models.load(config.model.checkpoint), names=names)
    assert adaptation.count(again).trainable == planned
    a, b = (leaves(nnx.state(lorasp_jax.merge(m), nnx.Param)) for m in (again, loaded))
    for name, value in a.items():
        np.testing.assert_allclose(value, b[name], atol=1e-6, err_msg=name)
