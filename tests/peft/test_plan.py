"""Plans of ranks: their files, the layers they fit, how ranks meet a budget, and controls."""

import json

import jax
import numpy as np
import pytest

from lorasp_jax.peft import AdaLoRA, DoRA, FullFineTuning, LoRA, LoRAMoE, LoRASP, plan
from lorasp_jax.peft.plan import RankPlan

SHAPES = {"a/q_proj": (3, 8, 16), "a/o_proj": (3, 16, 8), "a/up": (2, 8, 40), "head": (1, 40, 4)}
IMPORTANCE = {"a/q_proj": (1.0, 5.5, 2.0), "a/o_proj": (0.5, 3.0, 0.0), "a/up": (4.0, 7.0)}
IMPORTANCE |= {"head": (6.0,)}
PLAN = RankPlan("pi0", {"a/q_proj": (1, 6, 2), "a/o_proj": (0, 3, 0), "a/up": (4, 7), "head": (0,)})
UNIFORM = sum(layers * (d_in + d_out) for layers, d_in, d_out in SHAPES.values())
LARGEST = max(d_in + d_out for _, d_in, d_out in SHAPES.values())


def parameters(ranks, shapes=SHAPES):
    return sum(sum(each) * sum(shapes[path][1:]) for path, each in ranks.items())


def flat(ranks):
    return np.concatenate([ranks[path] for path in SHAPES])


@pytest.mark.parametrize("mean", [1, 2, 2.7, 4, 5])
@pytest.mark.parametrize("drop", [0, 2])
def test_a_budget_is_met_within_one_direction(mean, drop):
    budget = mean * UNIFORM
    ranks = plan.allocate(IMPORTANCE, SHAPES, budget, most=8, drop=drop)
    RankPlan("pi0", ranks).check(SHAPES)
    left = budget - parameters(ranks)
    assert 0 <= left < LARGEST
    assert (flat(ranks) == 0).sum() == drop
    assert flat(ranks).min() >= (not drop)
    assert ranks["head"][0] <= 4  # min(I, O)
    kept = flat(ranks) > 0
    order = np.argsort(flat(IMPORTANCE)[kept], kind="stable")
    of_wide = np.repeat([min(i, o) >= 8 for _, i, o in SHAPES.values()], [3, 3, 2, 1])[kept][order]
    assert (np.diff(flat(ranks)[kept][order][of_wide]) >= -1).all()  # in the order of importance


def test_ranks_are_proportional_to_importance():
    importance = {path: tuple(2 * x for x in values) for path, values in IMPORTANCE.items()}
    budget = sum(sum(IMPORTANCE[p]) * (i + o) for p, (_, i, o) in SHAPES.items())
    ranks = plan.allocate(importance, SHAPES, budget, most=100, least=0)
    expected = np.minimum(flat(IMPORTANCE), [8] * 8 + [4])
    assert np.abs(flat(ranks) - expected).max() <= 1


def test_equal_layers_use_the_budget():
    equal = {path: (1.0,) * layers for path, (layers, _, _) in SHAPES.items()}
    ranks = plan.allocate(equal, SHAPES, 2.5 * UNIFORM, most=8)
    assert {2, 3} == set(flat(ranks))
    assert 2.5 * UNIFORM - parameters(ranks) < LARGEST


def test_impossible_budgets():
    with pytest.raises(ValueError, match="is too small for ranks of at least 1: 9 layers"):
        plan.allocate(IMPORTANCE, SHAPES, UNIFORM - 1, most=8)


@pytest.mark.parametrize("drop", [-1, 9, 15])
def test_impossible_drops(drop):
    with pytest.raises(ValueError, match=f"at least 0 and below 9 layers, got {drop}"):
        plan.allocate(IMPORTANCE, SHAPES, 10 * UNIFORM, most=8, drop=drop)


@pytest.mark.parametrize("value", [np.nan, np.inf, -0.5])
def test_impossible_importance(value):
    with pytest.raises(ValueError, match=f"finite and at least 0, got {value} for head"):
        plan.allocate(IMPORTANCE | {"head": (value,)}, SHAPES, 3 * UNIFORM, most=8)


def test_a_plan_keeps_its_budget():
    count = PLAN.count(SHAPES)
    assert count == parameters(PLAN.ranks)
    RankPlan("pi0", PLAN.ranks, budget=count).check(SHAPES)
    with pytest.raises(ValueError, match=f"has {count:,} parameters, more than its budget of"):
        RankPlan("pi0", PLAN.ranks, budget=count - 1).check(SHAPES)


def test_a_shuffled_plan_has_as_many_parameters():
    control = plan.shuffled(PLAN, SHAPES, jax.random.key(1))
    control.check(SHAPES)
    assert parameters(control.ranks) == parameters(PLAN.ranks)
    attention = ("a/q_proj", "a/o_proj")  # [I, O] and [O, I] are alike
    before, after = ([x for p in attention for x in y.ranks[p]] for y in (PLAN, control))
    assert before != after
    assert sorted(before) == sorted(after)
    assert sorted(control.ranks["a/up"]) == [4, 7]
    assert control.ranks["head"] == (0,)
    assert control == plan.shuffled(PLAN, SHAPES, jax.random.key(1))
    assert control.rule == "shuffled"


def test_files(tmp_path):
    PLAN.save(tmp_path / "plan.json")
    assert plan.read(tmp_path / "plan.json") == PLAN
    assert '"a/q_proj": [1, 6, 2],\n' in (tmp_path / "plan.json").read_text()
    by_hand = {"format": plan.FORMAT, "version": 1, "backbone": "pi0", "ranks": {"head": [2]}}
    (tmp_path / "plan.json").write_text(json.dumps(by_hand))
    assert plan.read(tmp_path / "plan.json") == RankPlan("pi0", {"head": (2,)})


GOOD = {"format": plan.FORMAT, "version": 1, "backbone": "pi0", "ranks": {"head": [2]}}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", r"plan.json is invalid \("),
        ("[]", "it must be an object"),
        (json.dumps(GOOD | {"version": 2}), "must be a lorasp_jax plan of version 1"),
        (json.dumps({"ranks": {}}), "lacks 'format'"),
        (json.dumps({k: v for k, v in GOOD.items() if k != "backbone"}), "lacks 'backbone'"),
        (json.dumps(GOOD | {"ranks": {"head": [1.5]}}), "must be a whole number, got 1.5"),
        (json.dumps(GOOD | {"ranks": {"head": 3}}), "ranks.head must be a list"),
        (json.dumps(GOOD | {"ranks": {"head": [3, -1]}}), "at least 0, got -1 for head"),
        (json.dumps(GOOD | {"ranks": {"head": [0]}}), "must have a rank above 0"),
        (json.dumps(GOOD | {"rank": 3}), "has no field 'rank'"),
    ],
)
def test_other_files(tmp_path, text, message):
    (tmp_path / "plan.json").write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        plan.read(tmp_path / "plan.json")
    assert "plan.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_file(tmp_path):
    with pytest.raises(ValueError, match="is missing"):
        plan.read(tmp_path / "plan.json")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"b/q_proj": (1,)}, "the plan has 'b/q_proj', which is none of the 4 layers .* a/q_proj"),
        ({"head": None}, "the plan lacks head, one of the 4 layers to adapt"),
        ({"head": (1, 1)}, "must have 1 ranks for head, one per layer, got 2"),
        ({"head": (5,)}, "rank 5 for head, but its kernels are 40 x 4: at most 4"),
    ],
)
def test_plans_for_other_layers(change, message):
    ranks = {path: each for path, each in (PLAN.ranks | change).items() if each is not None}
    with pytest.raises(ValueError, match=message):
        RankPlan("pi0", ranks).check(SHAPES)


def test_rules_keep_the_scale():
    for method in (
        LoRA(),
        LoRA(rank=16, alpha=8.0, dropout=0.1),
        LoRA(rank=16, rank_stabilized=True),
    ):
        rules = PLAN.rules(method)
        assert rules["head"] == ("^head$", None)
        for path in ("a/q_proj", "a/o_proj", "a/up"):
            pattern, planned = rules[path]
            assert pattern == f"^{path}$"
            assert planned.scale == pytest.approx(method.scale, rel=1e-12)
            assert (planned.rank, planned.ranks) == (max(PLAN.ranks[path]), PLAN.ranks[path])
            assert planned.dropout == method.dropout


@pytest.mark.parametrize(
    ("method", "message"),
    [
        *((m, f"is for lora or dora, not for {m.name}") for m in (LoRASP(), LoRAMoE(), AdaLoRA())),
        (FullFineTuning(), "not for full"),
        (DoRA(), "dora needs ranks of at least 1 or only 0 in the stack a/o_proj"),
        *(
            (LoRA(rank=2, initialization=name), f"'{name}' depends on the rank")
            for name in ("gaussian", "pissa", "olora")
        ),
    ],
)
def test_methods_that_cannot_have_a_plan(method, message):
    with pytest.raises(ValueError, match=message):
        PLAN.rules(method)
