"""The study of where adaptive rank pays: its cells, their plans, and its page."""

import dataclasses
import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.config import AuxiliaryConfig, Config
from lorasp_jax.data.batches import flatten
from lorasp_jax.dense import AdaptedLayer, AdapterParam
from lorasp_jax.extras.study import Derived, statistics
from lorasp_jax.models import flow_matching, presets
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig
from lorasp_jax.peft import FullFineTuning, LoRA, LoRASP, plan
from lorasp_jax.peft.settings import to_settings
from lorasp_jax.training import activations, rules
from studies.paper.transforms import cut
from studies.where_it_pays import (
    bases,
    cutting,
    forms,
    judge,
    page,
    recipes,
    sequence_page,
    sequences,
    study,
)
from tests.models.random_models import random_backbone, with_noise
from tests.runs import CONFIG, make_run, random_episodes

STUDY = study.get_study("accelerator")
STUDY_NAMES = {cell.name for cell in STUDY.cells}
SCALE = study._ACCELERATOR


def active(backbone):
    """Active ranks of 1, 2, 3 ... in the layers of a backbone."""
    found, number = {}, 0
    shapes = study._shapes(backbone, "small", SCALE.config.targets)
    for path, (layers, _, _) in shapes.items():
        ranks = [float(number + i + 1) for i in range(layers)]
        found.setdefault(rules.tower(path), {})[rules.short_name(path)] = ranks
        number += layers
    return found


def episodes(rate):
    """Outcomes of forty episodes."""
    return "1" * round(40 * rate) + "0" * (40 - round(40 * rate))


def forgetting(kind, order):
    """Outcomes of a policy by number of learned tasks and task.

    Of a task's episodes, 10 % succeed in the base, 20 % after other tasks, 80 % right after it,
    then 90 %, and 60 % at the end, or 70 % with a kind of LoRA-SP.
    """
    tasks = page.SEQUENCES.orders[order]
    if kind in sequence_page.SINGLE:
        return {f"{k}/{task}": episodes(0.6 + k / 20) for k, task in enumerate(tasks, 1)}
    end = 0.6 if sequence_page.KINDS[kind][0] == "lora" else 0.7
    found = {}
    for done in range(len(tasks) + 1):
        for k, task in enumerate(tasks, 1):
            rate = (0.1 + 0.1 * (done > 0), 0.8, 0.9)[np.sign(done - k) + 1]
            found[f"{done}/{task}"] = episodes(end if done == len(tasks) > k else rate)
    return found


@pytest.fixture(scope="module")
def results():
    """Results of all policies, of which those at the higher rate are the best."""
    found = {}
    for cell in STUDY.cells:
        backbone, kind, *_ = cell.name.split("/")
        text = episodes(0.5 + 0.2 * cell.name.endswith("0.003"))
        if kind in ("form_half", "recipe_relu", "planned", "second"):
            text = episodes(0.25 if "/lora/" in cell.name else 0.75)
        outcomes = {f"{s}/{t}": text for s in page.SCENES for t in page.SEQUENCES.orders[0]}
        if kind in sequence_page.KINDS:
            outcomes = forgetting(kind, int(cell.name.split("/")[2][1]))
        found[cell.name] = {
            "outcomes": outcomes,
            "trainable_parameters": 1000,
            "bytes": 2e6,
            "layer_active_rank": active(backbone),
            **({"protected": [0.25, 0.5]} if kind == "protected" else {}),
        }
    return found


def test_policies_differ_in_what_their_names_say(results):
    for cell in STUDY.cells:
        if "pilot" in cell.name or "base_" in cell.name:
            continue
        backbone, method, *rank, seed = cell.name.split("/")
        if isinstance(cell, Derived):
            assert cell.source in STUDY_NAMES
            assert (cell.source.split("/")[0], cell.source.split("/")[-1]) == (backbone, seed)
            if method in sequence_page.KINDS:
                kind = [sequence_page.KINDS[method][0], "r16" if "16" in method else "r64"]
                assert cell.source.split("/")[1:3] == kind
                assert cell.settings["tasks"] == [*page.SEQUENCES.orders[int(rank[0][1])]]
            continue
        config = cell.config if isinstance(cell.config, Config) else cell.config(results)
        assert config.model.backbone == backbone
        assert f"s{config.seed}" == seed
        assert method == "medium" or config.optim.learning_rate == 3e-3
        if method.startswith("recipe_"):
            assert config.seed in page.RECIPE_SEEDS
            continue
        if method in bases.BASES:
            assert config.model.checkpoint == f"runs/where_it_pays/{cell.source}/base"
            assert config.model.size == bases.BASES[method][0]
            assert isinstance(config.peft, FullFineTuning) == (rank == ["full"])
            continue
        ranked = method in (*study.MAKE, page.HALF) and method != "eva"
        assert bool(config.plan) != ranked
        assert len(config.tasks) == (2 if method == page.HALF else 4)
        named = config.peft.target_rank if method == "ada_lora" else config.peft.rank
        assert [f"r{named}"] == rank


@pytest.mark.parametrize("backbone", page.BACKBONES)
def test_plans_have_the_parameters_of_one_rank(backbone):
    shapes = study._shapes(backbone, "small", SCALE.config.targets)
    sizes = {path: d_in + d_out for path, (_, d_in, d_out) in shapes.items()}

    def parameters(kind, rank=8):
        made = study.make_plan(kind, backbone, SCALE, active(backbone), rank, 0)
        return made, sum(sizes[path] * sum(ranks) for path, ranks in made.ranks.items())

    whole = 8 * sum(layers * sizes[path] for path, (layers, _, _) in shapes.items())
    planned, used = parameters("planned")
    assert 0 <= whole - used < max(sizes.values())
    shuffled, same = parameters("shuffled")
    assert same == used
    assert shuffled.ranks != planned.ranks
    for kind in ("dropped", "dropped_random"):
        dropped, left = parameters(kind)
        assert whole / 2 <= left < 0.6 * whole
        assert {*dropped.ranks} == {*shapes}
    other = {"pi0": "smolvla", "smolvla": "pi0"}[backbone]
    borrowed = study.make_plan("other_backbone", backbone, SCALE, active(other), 8, 0)
    used = sum(sizes[path] * sum(ranks) for path, ranks in borrowed.ranks.items())
    assert 0 <= whole - used < max(sizes.values())
    assert all(max(ranks) - min(ranks) <= 1 for ranks in borrowed.ranks.values())
    low = [path for path, ranks in parameters("dropped")[0].ranks.items() if not any(ranks)]
    means = {
        path: np.mean(active(backbone)[rules.tower(path)][rules.short_name(path)])
        for path in shapes
    }
    assert np.mean([means[path] for path in low]) < np.mean([*means.values()])


def test_page(results, tmp_path, monkeypatch):
    monkeypatch.setattr(statistics, "DRAWS", 50)
    monkeypatch.setattr(statistics, "_counts", statistics._counts.__wrapped__)
    for found in ({}, results):
        blocks = page.blocks(STUDY, found, tmp_path)
        assert (tmp_path / "ranks.svg").exists()
        assert ("50.0 [" in blocks["pi0 ranks"].replace("\u00a0", " ")) == bool(found)
        assert len(blocks["smolvla layers"].splitlines()) == 2 + len(page.ALLOCATED)
    shown = {name: numbers(block) for name, block in blocks.items()}
    lora = ["65.0", "+15.0", "80.0", "80.0", "+20.0", "–", "+10.0", "–", "3"]
    assert shown["pi0 sequences"]["LoRA"] == lora
    lora_sp = ["72.5", "+22.5", "80.0", "80.0", "+10.0", "−10.0", "+10.0", "–", "3"]
    assert shown["pi0 sequences"]["LoRA-SP"] == lora_sp
    protected = shown["pi0 sequences"]["LoRA-SP, used directions protected"]
    assert protected == [*lora_sp[:5], "+0.0", "+10.0", "50 %", "3"]
    alone = ["72.5", "+22.5", "72.5", *["–"] * 5, "3"]
    assert shown["pi0 sequences"]["one LoRA per task, r = 16"] == alone
    half = ["75.0", "+25.0", "+25.0"] * 2
    assert shown["pi0 forms"]["half of the bank"] == [*half, "2.0 MB", "3"]
    assert shown["pi0 forms"]["whole"][:3] == ["50.0", "–", "+0.0"]
    layers = shown["smolvla layers"]
    assert layers["the former minus the latter"] == ["+25.0"] * 3
    assert layers["ranks of another seed, minus own"] == ["−25.0", "–", "–"]
    spans = [["+0.0"] * 2] * 3
    assert [*shown["contrasts"].values()] == [*spans, ["+0.0"] * 2, ["+50.0"] * 2]
    assert layers["ranks of the other backbone, by kind of layer, minus own"][0] == "−25.0"
    rates = {"4": "50.0 (0.001), 70.0 (0.003), 50.0 (0.01)"}
    rates["128"] = "50.0 (0.0003), 50.0 (0.001), 70.0 (0.003)"
    assert {rank: shown["pilots"][rank] for rank in rates} == {r: [x] * 4 for r, x in rates.items()}
    assert shown["recipes"]["ReLU scores"] == [*["75.0", "+25.0"] * 2, "3"] * 2
    lines = [line.split(" | ") for line in blocks["pi0 bases"].splitlines() if "| second" in line]
    rates = [[cell.split("\u00a0")[0] for cell in line[2:4]] for line in lines[1:]]
    assert rates == [["25.0", "–"], ["75.0", "+50.0"]]


def numbers(block):
    """The numbers of a table's rows without their intervals, by label."""
    lines = block.replace("\u00a0", " ").splitlines()[2:]
    rows = [line.strip("| ").split(" | ") for line in lines]
    return {row[0]: [cell.split(" [")[0] for cell in row[1:]] for row in rows}


def test_the_recipes_differ_in_one_thing():
    made = [recipes.RECIPES[name] for name in recipes.RECIPES]
    assert all(first != other for i, first in enumerate(made) for other in made[:i])
    assert {*recipes.RECIPES, *recipes.CHANGES} == {*page.RECIPES}
    plain = to_settings(recipes.RECIPES["lora_sp"][0])
    losses = dataclasses.asdict(AuxiliaryConfig())
    for name, (method, changes) in recipes.RECIPES.items():
        settings, changed = to_settings(method), changes.get("auxiliary", AuxiliaryConfig())
        count = sum(settings[x] != plain[x] for x in plain) + ("adapt" in changes)
        count += sum(value != losses[x] for x, value in dataclasses.asdict(changed).items())
        assert count == (name != "lora_sp")


def test_pilots_decide_by_success_as_recorded():
    pilots = [cell for cell in STUDY.cells if "/pilot/" in cell.name]
    assert {cell.name.split("/")[1] for cell in pilots} == {"pilot", "medium"}
    assert all(cell.evaluate.keywords == {"scenes": ("recorded",)} for cell in pilots)


def test_a_recipe_with_lora_in_a_part_takes_the_lower_rate(results):
    for rate, share in (("0.001", 0.9), ("0.003", 0.1)):
        name = f"pi0/pilot/lora_r64/{rate}"
        outcomes = dict.fromkeys(results[name]["outcomes"], episodes(share))
        results = {**results, name: {**results[name], "outcomes": outcomes}}
    for recipe, rate in {"lora_sp": 3e-3, "vlm": 1e-3, "expert": 1e-3}.items():
        config = STUDY[f"pi0/recipe_{recipe}/s1001"].config(results)
        assert config.optim.learning_rate == rate


@pytest.mark.parametrize("name", recipes.CHANGES)
def test_a_changed_policy_begins_anew(name, tmp_path, monkeypatch):
    config, base = dataclasses.replace(CONFIG, peft=LoRASP(rank=64)), Pi0Config.dummy()
    (folder := tmp_path / "pi0" / "recipe").mkdir(parents=True)
    run = make_run(folder / "s1001", config, random_backbone(base))
    start, began = run.policy.model, []
    monkeypatch.setattr(recipes.setup, "build", lambda *_: SimpleNamespace(model=start))
    monkeypatch.setattr(recipes, "shared_demonstrations", lambda *_: run.episodes)
    monkeypatch.setattr(recipes.loop, "trained", lambda x: began.append(x.policy) or run.policy)
    monkeypatch.setattr(recipes, "judge_scenes", lambda x: x.policy)
    assert recipes.judge_changed(run, name, 0) is run.policy
    (policy,) = began
    assert policy.processor is run.policy.processor
    assert {*adapted(policy.model)} == {*adapted(start)}


def test_tasks_without_demonstrations_keep_the_numbers_of_instructions():
    every = {task: random_episodes(task, 0) for task in ("press", "pour", "pick_place")}
    shown = sequences.some(every, {"pour": 2})
    assert [group.num_episodes for group in shown.values()] == [0, 2, 0]
    rows = flatten([*shown.values()]).instruction
    first = len(every["press"].instructions)
    assert {*rows.tolist()} == {*(first + every["pour"].instruction[:2]).tolist()}


@pytest.mark.parametrize("kind", ["sequential_sp", "protected", "no_spectral", "single"])
def test_a_sequence_learns_task_after_task(kind, tmp_path, monkeypatch):
    tasks, learned, shown = ("press", "pick_place"), [], []
    config = dataclasses.replace(CONFIG, tasks=tasks)
    (folder := tmp_path / "pi0" / kind / "o0").mkdir(parents=True)
    run = make_run(folder / "s0", config, random_backbone(Pi0Config.dummy()))
    start = run.policy.model
    every = {task: random_episodes(task, 0) for task in tasks}

    def train(stage):
        learned.append((stage, [task for task, x in stage.episodes.items() if x.num_episodes]))
        return real(stage)

    def evaluate(run, scenes):
        layer = next(x.child for x in paths.locate(nnx.List([run.policy.model]), AdaptedLayer))
        params = layer.adapter.get_value()
        shown.append([np.array(params["router"]["w1"]), np.array(params["bank"]["u"])])
        return {"outcomes": {f"{scene}/{x}": "01" for scene in scenes for x in run.config.tasks}}

    real = sequences.loop.trained
    monkeypatch.setattr(sequences.loop, "trained", train)
    monkeypatch.setattr(sequences.scenes, "judge", evaluate)
    monkeypatch.setattr(sequences.setup, "build", lambda *_: SimpleNamespace(model=start))
    monkeypatch.setattr(sequences, "shared_demonstrations", lambda *_: every)
    found = sequences.judge(run, kind, 0, 0)
    stages, of = zip(*learned, strict=True)
    assert [*of] == [["press"], ["pick_place"]]
    assert [x.config.optim.steps for x in stages] == [CONFIG.optim.steps // 2] * 2
    rate = CONFIG.optim.learning_rate if kind == "single" else sequences.RATE
    assert [x.config.optim.learning_rate for x in stages] == [rate] * 2
    assert [x.config.auxiliary.spectral == 0 for x in stages] == [kind == "no_spectral"] * 2
    began = [stage.policy.model is start for stage in stages]
    assert began == [True, kind == "single"]
    if kind == "single":
        assert [*found["outcomes"]] == ["1/press", "2/pick_place"]
        return
    assert [*found["outcomes"]] == [f"{k}/{task}" for k in range(3) for task in tasks]
    moved = [
        [bool((new != old).any()) for new, old in zip(after, before, strict=True)]
        for before, after in itertools.pairwise(shown)
    ]
    assert moved[0] == [True, True]  # the first task trains all
    assert moved[1][0] == (kind != "protected")
    assert ("protected" in found) == (kind == "protected")


@pytest.fixture(scope="module")
def lora():
    config = dataclasses.replace(CONFIG, peft=LoRA(rank=2))
    return config, with_adapters(config)


def with_adapters(config):
    """A tiny model with adapters that change its outputs."""
    model = random_backbone(Pi0Config.dummy())
    graphdef, adapters, frozen = adaptation.split(
        adaptation.adapt(model, rules.rules(config), rngs=nnx.Rngs(0))
    )
    return nnx.merge(graphdef, with_noise(adapters, 0.1), frozen)


def test_a_cut_policy_is_lora_with_fewer_parameters(tmp_path):
    config = dataclasses.replace(CONFIG, peft=LoRA(rank=4))
    run = make_run(tmp_path, config, random_backbone(Pi0Config.dummy()))
    own = dataclasses.replace(run.policy, model=with_adapters(config))
    shapes = rules.shapes(random_backbone(Pi0Config.dummy()), presets.patterns(config.targets))
    sizes = [n * (d_in + d_out) for n, d_in, d_out in shapes.values()]
    for rank, atol in ((2, None), (4, 1e-5)):
        smaller = cut(own, rank, by_size=True)
        found, count = cutting.as_lora(smaller)
        assert rank * sum(sizes) - max(sizes) < count <= rank * sum(sizes)
        assert {type(x) for x in adaptation.methods(found.model).values()} == {LoRA}
        merged = [adaptation.merge(x.model) for x in (smaller, found, own)]
        for path in ("action", "language"):
            kernels = [getattr(x, path).blocks.q_proj.kernel.get_value() for x in merged]
            np.testing.assert_allclose(*kernels[:2], atol=1e-5)
            assert (np.abs(kernels[1] - kernels[2]).max() > 1e-3) == (atol is None)


def test_active_ranks_that_are_lost_are_missed(tmp_path):
    run = make_run(tmp_path, CONFIG, random_backbone(Pi0Config.dummy()))
    with pytest.raises(ValueError, match="active ranks are lost"):
        judge.judge(run)


def test_half_of_an_update_is_merged(lora):
    config, model = lora
    after = sequences._interpolated(model, config, 1)
    assert {method.rank for method in adaptation.methods(after).values()} == {2}
    kernel = lambda model: model.action.blocks.q_proj.kernel.get_value()  # noqa: E731
    base, whole = kernel(model), kernel(adaptation.merge(model))
    np.testing.assert_allclose(kernel(after), base / 2 + whole / 2, atol=1e-5)
    assert np.abs(whole - base).max() > 1e-3
    for location in paths.locate(nnx.List([after]), AdaptedLayer):
        if location.child.adapter is not None:  # new ones, without an update
            assert not np.any(location.child.adapter.get_value()["lora_b"])


def test_a_policy_that_teaches_itself_makes_no_error(lora, tmp_path):
    config, model = lora
    run = make_run(tmp_path, config, random_backbone(Pi0Config.dummy()))
    key, batch = next(activations.sampled(run, run.policy.processor, model.config.chunk))
    noise, time = flow_matching.draw(key, batch.actions)
    drawn = batch, noise, time
    errors, aux = forms.Taught(model)(model, model, *drawn)
    assert float(jnp.abs(errors).max()) < 1e-8
    assert {*aux} >= {"vision", "action"}
    assert float(forms.Taught(with_adapters(CONFIG))(model, model, *drawn)[0].mean()) > 1e-6


def adapted(model):
    """The adapted layers of a model by path."""
    found = {x.path: x.child for x in paths.locate(nnx.List([model]), AdaptedLayer)}
    return {path: layer for path, layer in found.items() if layer.adapter is not None}


def banks(model):
    """V of the layers of a model by path."""
    return {path: x.adapter.get_value()["bank"]["v"] for path, x in adapted(model).items()}


def test_leading_inputs_begin_the_bank(monkeypatch, tmp_path):
    model = with_adapters(CONFIG)
    before, third = banks(model), {}
    for path, v in before.items():
        third[path] = jnp.zeros((*v.shape[:-1], v.shape[-2])).at[..., 3, 3].set(1.0)
    monkeypatch.setattr(recipes.calibration, "input_moments", lambda *_: third)
    run = make_run(tmp_path, CONFIG, random_backbone(Pi0Config.dummy()))
    after = banks(recipes.CHANGES["eva"](run, model))
    for path, v in after.items():
        lengths = [np.linalg.norm(bank[path], axis=-2) for bank in (before, after)]
        np.testing.assert_allclose(*lengths, rtol=1e-5)
        first = np.abs(v[..., 0]) / lengths[1][..., :1]
        np.testing.assert_allclose(first, np.broadcast_to(np.eye(v.shape[-2])[3], first.shape))


def test_leading_directions_of_the_kernels_begin_the_bank():
    model = with_adapters(CONFIG)
    after = recipes.CHANGES["pissa"](None, model)
    for path, v in banks(after).items():
        kernel = adapted(model)[path].kernel_matrices()
        leading = jnp.linalg.svd(kernel)[0][..., 0]
        cosine = (v[..., 0] * leading).sum(-1) / jnp.linalg.norm(v[..., 0], axis=-1)
        np.testing.assert_allclose(jnp.abs(cosine), 1, atol=1e-3)
    assert any((v != banks(after)[path]).any() for path, v in banks(model).items())


def test_methods_of_the_action_expert_and_of_the_others():
    made = recipes.CHANGES["eta_vlm"](None, with_adapters(CONFIG))
    targets = {path: layer.method.energy_target for path, layer in adapted(made).items()}
    assert targets == {path: 0.8 if rules.tower(path) == "action" else 0.99 for path in targets}
    assert {*targets.values()} == {0.8, 0.99}


def test_actions_of_a_chunk_share_their_scores():
    plain, shared = LoRASP(rank=8), recipes._SharedInChunk(rank=8)
    params = plain.init_params(jax.random.key(0), 16, 4)
    params["router"]["w2"] = jax.random.normal(jax.random.key(1), params["router"]["w2"].shape)
    x = jax.random.normal(jax.random.key(2), (3, 5, 16))
    x = x.at[1].set(x[1, :1])  # tokens that are equal
    found = [
        method.bottleneck(params, x @ method.down(params), None)[1].active_rank
        for method in (plain, shared)
    ]
    assert (found[0] != found[0][:, :1]).any()
    np.testing.assert_array_equal(found[1], jnp.broadcast_to(found[1][:, :1], found[1].shape))
    np.testing.assert_array_equal(found[0][1], found[1][1])
    assert shared.implementation(params) is shared
    assert plain != shared  # or they would share programs


def with_updates(model):
    """A model whose adapters change its outputs, where they have a rank."""
    graphdef, adapters, frozen = adaptation.split(model)
    root = nnx.List([nnx.merge(graphdef, with_noise(adapters, 0.1), frozen)])
    for location in paths.locate(root, AdaptedLayer):
        layer = location.child
        if isinstance(layer.method, LoRA):
            layer.adapter = AdapterParam(layer.method.trimmed(layer.adapter.get_value()))
    return root[0]


@pytest.mark.parametrize("backbone", [Pi0Config, SmolVLAConfig])
def test_policies_of_all_ranks_share_the_programs_of_evaluation(backbone, tmp_path):
    base = random_backbone(backbone.dummy())
    shapes = rules.shapes(base, presets.patterns(("all-linear",)))
    ranks = {path: tuple(range(1, n + 1)) for path, (n, _, _) in shapes.items()}
    dropped = next(path for path in ranks if "down_proj" in path)
    planned = plan.RankPlan("pi0", ranks | {dropped: (0,) * len(ranks[dropped])})
    structures = []
    for method, chosen in ((LoRA(rank=4), planned), (LoRA(rank=64), None), (LoRASP(rank=8), None)):
        config = dataclasses.replace(CONFIG, peft=method, plan=chosen, targets=("all-linear",))
        run = make_run(tmp_path / f"{method.name}{method.rank}", config, base)
        own = dataclasses.replace(run.policy, model=with_updates(run.policy.model))
        shown = judge.padded(own, config.targets)
        structures.append(adaptation.split(shown.model)[0])
        key, batch = next(activations.sampled(run, own.processor, base.config.chunk))
        loss = jax.jit(lambda x: x.model.loss(key, batch.observation, batch.actions)[0])  # noqa: B023
        chunks = [loss(x) for x in (own, shown, run.policy)]
        np.testing.assert_allclose(*chunks[:2], rtol=1e-4, atol=1e-5)
        assert float(jnp.abs(chunks[0] - chunks[2]).max()) > 1e-2
    assert structures[0] == structures[1] != structures[2]
