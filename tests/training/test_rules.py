"""Methods by rule: how rules are parsed, what they train, and a mixed run from start to report."""

import dataclasses
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax import models
from lorasp_jax.adapters import adaptation, paths, summary
from lorasp_jax.config import ModelConfig
from lorasp_jax.evaluation.callback import NoEvaluation
from lorasp_jax.extras.deployment import variants
from lorasp_jax.models import backbone, pi0, presets, smolvla
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import AdaLoRA, FullFineTuning, LoRA, LoRASP
from lorasp_jax.report.html import write_report
from lorasp_jax.training import base, export, rules, run_folder, setup
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.fixed_batches import forward, keyed_batches
from lorasp_jax.training.loop import train
from lorasp_jax.training.overrides import parse
from lorasp_jax.training.run_folder import read_json, to_json, write_json
from tests.cases import mostly_slow
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, RESULTS, Terminate, leaves, make_run, random_episodes, repeatable

MULTITASK = ["--config", "configs/multitask.py", "--scale", "smoke"]
MIXED = ("language/blocks/(q|v)_proj=lora:4", "vision/blocks/q_proj=lora_sp", "action=full")
"""LoRA-SP has the settings of `CONFIG.peft`."""
FULL = FullFineTuning()


def with_rules(*texts, **changes):
    return dataclasses.replace(CONFIG, adapt=texts, **changes)


def shapes(config, model_config=None):
    """Return the adapted model of a run, with shapes in place of arrays."""
    return preflight.abstract_model(config, model_config or Pi0Config.dummy())


def test_rules_on_the_command_line():
    config = parse([*MULTITASK, "--adapt", *MIXED, "--peft.energy-target", "0.8"]).config
    assert config.adapt == MIXED
    language, vision, action = rules.rules(config)
    assert language == ("language/blocks/(q|v)_proj", LoRA(rank=4))
    assert vision == ("vision/blocks/q_proj", LoRASP(rank=8, energy_target=0.8))
    assert action == ("^action/", FULL)


def test_settings_come_from_the_config_for_its_method_only():
    current = LoRASP(rank=8, hidden_width=4)
    found = presets.parse(["a=lora_sp:2", "b=lora_sp", "c=lora", "d=none"], current)
    assert [method for _, method in found.values()] == [
        LoRASP(rank=2, hidden_width=4),
        current,
        LoRA(),
        None,
    ]
    (pattern, method), *_ = presets.parse(["(?=vision)v=lora:3"]).values()
    assert (pattern, method) == ("(?=vision)v", LoRA(rank=3))


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        (["language"], ["'language' is no rule", "TARGET=METHOD[:RANK]", *presets.RECIPES]),
        (["=lora"], ["'=lora' is no rule"]),
        (["a=lorra"], ["'lorra'", "lora_sp", "none"]),
        (["a=full:3"], ["full has no rank", "'a=full'"]),
        (["a=none:3", "b=lora"], ["none has no rank", "'a=none'"]),
        (["a=lora:x"], ["'a=lora:x'", "whole number"]),
        (["a=lora:0"], ["'a=lora:0'", "rank must be at least 1"]),
        (["a=none"], ["no rule has a method", "lora_sp"]),
        (["expert-olny=lora"], ["unknown preset 'expert-olny'", *presets.PRESETS]),
        (["a=lora", "--targets", "vision"], ["--targets", "--adapt"]),
        (["a=lora", "--peft.rank", "3"], ["--peft.rank sets lora_sp", "TARGET=lora_sp"]),
        (["paper", "--peft.rank", "3"], ["--peft.rank sets lora_sp", "TARGET=lora_sp"]),
        (["a=lora", "--method", "dora"], ["--method sets dora", "TARGET=dora"]),
        (["a=full", "--model.base-dtype", "nf4"], ["model.base_dtype must be empty for full"]),
    ],
)
def test_mistakes_are_one_sentence(texts, words):
    with pytest.raises(ValueError, match=r"^[^\n]+$") as caught:
        parse([*MULTITASK, "--adapt", *texts])
    for word in words:
        assert word in str(caught.value)


def test_rules_that_match_nothing_are_refused():
    with pytest.raises(ValueError, match="'visoin' applies to nothing; available layers: vision"):
        shapes(with_rules("visoin=lora:2", "action=full"))
    with pytest.raises(ValueError, match="'q_proj' applies to nothing: earlier rules take action"):
        shapes(with_rules("all-linear=lora:2", "q_proj=full"))


def test_recipes_are_in_the_help(capsys):
    with pytest.raises(SystemExit):
        parse(["--help"])
    words = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert f"a recipe ({', '.join(presets.RECIPES)})" in words


@pytest.mark.parametrize("name", presets.RECIPES)
@pytest.mark.parametrize("kind", mostly_slow([pi0, smolvla], [pi0]))
def test_recipes_fit_every_backbone(name, kind):
    methods = adaptation.methods(shapes(with_rules(name), kind.Config.dummy()))
    expected = {method for _, method in presets.RECIPES[name]}
    assert set(methods.values()) == expected


def test_recipes_train_what_their_projects_train():
    """Without LoRA, whose matrices are per head in openpi, which trains 468,039,440 in all."""
    model = shapes(with_rules("openpi-lora"), Pi0Config.base())
    lora = 16 * 1_225_728 + 32 * 433_152
    assert adaptation.count(model).trainable - lora == 468_039_440 - 49_987_584
    molmoact = shapes(with_rules("vlm-lora+expert-full"))
    frozen = paths.locate(nnx.List([molmoact]), nnx.Param)
    frozen = [p.path for p in frozen if not isinstance(p.child, adaptation.AdapterParam)]
    assert all(path.startswith(("vision/", "language/")) for path in frozen)


@pytest.mark.slow
def test_the_expert_is_what_lerobot_trains_of_smolvla():
    lerobot = shapes(with_rules("expert-only"), smolvla.Config.base())
    assert adaptation.count(lerobot).trainable == 99_880_992


def test_the_first_rule_wins_and_every_parameter_is_counted_once():
    config = with_rules(
        "vision/blocks/q_proj=none", "bias$=full", "vision=lora_sp:2", "paper=lora:3"
    )
    model = shapes(config)
    methods = adaptation.methods(model)
    assert "vision/blocks/q_proj" not in methods
    assert methods["vision/blocks/fc1/bias"] == FULL
    assert methods["vision/head"] == dataclasses.replace(CONFIG.peft, rank=2)
    assert methods["action_out_proj"] == LoRA(rank=3)
    found = rules.by_rule(config, model)
    assert list(found) == list(config.adapt)
    assert found["vision/blocks/q_proj=none"] == {"layers": 0, "parameters": 0}
    assert sum(row["parameters"] for row in found.values()) == adaptation.count(model).trainable
    depth = Pi0Config.dummy().vision.depth
    assert found["vision=lora_sp:2"]["layers"] == 5 * depth + 2  # the head and the patches
    for rule, row in found.items():
        line = f"  {rule}: {row['layers']} layers, {row['parameters']:,} parameters"
        assert line in setup.headline(config, model).splitlines()
    assert "\n" not in setup.headline(CONFIG, shapes(CONFIG))


def test_active_rank_by_rule_is_the_mean_over_layers():
    config = with_rules(
        "vision/(head|blocks/fc1)=lora:2", "action_out_proj=lora:3", "state_proj=full"
    )
    depth = Pi0Config.dummy().vision.depth
    logged = {"active_rank/vision/head": 8.0, "active_rank/vision/fc1": 1.0}
    found = rules.by_rule(config, shapes(config), logged | {"active_rank/action": 7.0})
    assert found[config.adapt[0]]["active_rank"] == (8 + depth) / (depth + 1)
    assert all("active_rank" not in found[rule] for rule in config.adapt[1:])


def test_without_rules_nothing_changes():
    """Records of runs and studies from before there were rules stay as they are."""
    assert "adapt" not in to_json(CONFIG)
    assert rules.rules(CONFIG) == [(target, CONFIG.peft) for target in CONFIG.targets]
    assert rules.describe(CONFIG) == "LoRASP"


def test_a_changed_rule_is_no_resume(tmp_path):
    config = with_rules(*MIXED)
    with run_folder.open_run(config, tmp_path, resume=False):
        pass
    for other in (with_rules(*MIXED[:2], "action=lora:2"), CONFIG):
        with (
            pytest.raises(ValueError, match=r"different settings \(adapt\)"),
            run_folder.open_run(other, tmp_path, resume=True),
        ):
            pass
    with run_folder.open_run(config, tmp_path, resume=True):
        pass


def test_one_rank_budget_and_no_average_of_it():
    config = with_rules("q_proj=ada_lora:4", "v_proj=ada_lora:8", "o_proj=lora:2")
    with pytest.raises(ValueError, match="all AdaLoRA layers share one rank budget"):
        preflight.estimate_memory(config, Pi0Config.dummy())
    optim = dataclasses.replace(CONFIG.optim, ema=0.9)
    config = with_rules("q_proj=ada_lora:4", "v_proj=lora:2", optim=optim)
    with pytest.raises(ValueError, match="ema cannot be combined with ada_lora"):
        setup.check_sizes(config, 10)
    assert AdaLoRA(rank=4) in rules.methods(config)


def test_a_quantized_base_spares_what_is_trained_in_full():
    """So that openpi's recipe, for one, fits on a small card."""
    config = with_rules(*MIXED, model=ModelConfig(size="dummy", checkpoint="", base_dtype="nf4"))
    model = shapes(config)
    quantized = {
        p.path
        for p in paths.locate(nnx.List([model]), nnx.Param)
        if isinstance(p.child.get_value(), lorasp_jax.kernels.quantized_weights.QuantizedKernel)
    }
    assert "language/blocks/q_proj/kernel" in quantized
    assert not any(path.startswith("action/") for path in quantized)
    plain = shapes(with_rules(*MIXED))
    assert adaptation.count(model).trainable == adaptation.count(plain).trainable


def run_on(folder, source, config):
    model = dataclasses.replace(config.model, checkpoint=str(source))
    run = make_run(folder, dataclasses.replace(config, model=model), models.load(source))
    run.base_hash = models.weights_hash(source)
    return run


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A mixed run on nano, stopped after two of its three steps, resumed and finished."""
    folder = tmp_path_factory.mktemp("mixed")
    models.save(folder / "base", random_backbone(Pi0Config.nano()))
    optim = dataclasses.replace(CONFIG.optim, steps=3)
    config = with_rules(*MIXED, optim=optim, tasks=("press",), log_every=1)
    whole, halved = (run_on(folder / name, folder / "base", config) for name in ("whole", "run"))
    train(whole)
    with pytest.raises(KeyboardInterrupt):
        train(halved, [Terminate()])
    resumed = run_on(folder / "run", folder / "base", config)  # as in a new process
    write_json(resumed.folder / "config.json", to_json(resumed.config))
    train(resumed, [export.Export(), NoEvaluation()], resume=True)
    return whole, resumed


def assert_equal(a, b):
    found, expected = (leaves(nnx.state(model, nnx.Param)) for model in (a, b))
    assert found.keys() == expected.keys()
    for name, value in found.items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)


@pytest.mark.slow
def test_a_mixed_run_resumes_to_the_bit_and_loads(trained):
    whole, run = trained
    assert repeatable(run.folder) == repeatable(whole.folder)
    assert_equal(run.policy.model, whole.policy.model)
    before = leaves(nnx.state(models.load(run.config.model.checkpoint), nnx.Param))
    after = leaves(nnx.state(run.policy.model, nnx.Param))
    moved = {name for name, value in before.items() if (value != after[name]).any()}
    assert moved == {name for name in before if name.startswith("['action']")}
    loaded = export.load_policy(run.folder).model
    assert adaptation.methods(loaded) == adaptation.methods(run.policy.model)
    assert_equal(loaded, run.policy.model)


@pytest.mark.slow
def test_a_mixed_run_is_reported_by_rule(trained):
    _, run = trained
    recorded = read_json(run.folder / "results.json")["rules"]
    assert list(recorded) == list(MIXED)
    assert sum(row["parameters"] for row in recorded.values()) == run.parameters[0]
    language, vision, action = recorded.values()
    assert language["active_rank"] == 4
    assert 0 < vision["active_rank"] <= CONFIG.peft.rank
    assert "active_rank" not in action
    page = write_report(run.folder).read_text()
    assert f"{' '.join(MIXED)} on pi0" in page
    for rule, row in recorded.items():
        cells = f"<td>{rule}</td><td class=number>{row['layers']}</td>"
        assert f"{cells}<td class=number>{row['parameters']:,}</td>" in page


@pytest.mark.slow
def test_a_mixed_run_is_merged_pruned_and_deployed(trained, tmp_path):
    _, run = trained
    model = run.policy.model
    with pytest.raises(ValueError, match=r"vision/blocks/q_proj.*(prune|distill)"):
        lorasp_jax.merge(model)
    part = lorasp_jax.merge(model, "^(language|action)/")
    assert set(adaptation.methods(part)) == {"vision/blocks/q_proj"}
    with pytest.raises(ValueError, match="'langauge' applies to nothing"):
        lorasp_jax.merge(model, "langauge")
    batches = keyed_batches(run.policy, {"press": random_episodes("press", 0)}, 2, 1)["press"]
    (whole, _), (merged, _) = (forward(each, batches[0]) for each in (model, part))
    np.testing.assert_allclose(merged, whole, rtol=1e-4, atol=1e-5)
    distilled = lorasp_jax.merge(lorasp_jax.distill(model, batches, forward=forward)[0])
    assert not adaptation.methods(distilled)
    with pytest.raises(ValueError, match="lora_sp, which Hugging Face PEFT does not support"):
        lorasp_jax.save_peft(tmp_path / "peft", model, names=lambda path, i: f"{path}{i}")
    finished = Path(shutil.copytree(run.folder, tmp_path / "finished"))
    write_json(finished / "config.json", to_json(run.config))
    write_json(finished / "results.json", RESULTS)
    variants.check_run(finished)
    for form in ("half", "pruned"):
        policy = variants.in_form(run.policy, form, {"press": random_episodes("press", 0)})
        methods = adaptation.methods(policy.model)
        assert methods["action/blocks/q_proj/kernel"] == FULL
        assert methods["vision/blocks/q_proj"].rank <= (4 if form == "half" else 8)
        export.write_variant(tmp_path / form, policy, run.folder, quantized="int8")
        loaded = export.load_policy(tmp_path / form).model
        assert_equal(base.quantized(policy.model, "int8"), loaded)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pi0", "smolvla"])
def test_neighbours_may_have_any_methods(name):
    """Layers that share an input, and are computed together, have other methods or none."""
    config = backbone.find(name).dummy()
    texts = (
        "q_proj=lora_sp:2",
        "k_proj=full",
        "v_proj=lora:3",
        "gate_proj=dora:2",
        "fc1=lora_moe:2",
    )
    found = rules.rules(with_rules(*texts))
    model = adaptation.adapt(random_backbone(config), found, rngs=nnx.Rngs(0))
    graphdef, adapters, frozen = adaptation.split(model)
    batch = jax.tree.map(lambda x: jnp.ones(x.shape, x.dtype), preflight.abstract_batch(config, 2))

    def loss(adapters):
        return forward(nnx.merge(graphdef, adapters, frozen), (jax.random.key(0), batch))[0].mean()

    expected = forward(random_backbone(config), (jax.random.key(0), batch))[0].mean()
    value, gradient = jax.value_and_grad(loss)(adapters)
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert "k_proj" in summary.summary(model)
