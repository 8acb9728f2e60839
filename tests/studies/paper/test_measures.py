"""The summary of a cell has what applies to its method, as small JSON values."""

import dataclasses
import json

import pytest

from lorasp_jax.adapters import adaptation
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import FullFineTuning, LoRA
from lorasp_jax.policies.policy import Policy
from studies.paper import transforms
from studies.paper.measures import directions, gradients, measures
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, make_run
from tests.studies.paper.updates import add_noise

pytestmark = pytest.mark.slow
SIZES = {"batch_size": 4, "batches": 2}
TARGETS = ("fc1", "action/blocks/q_proj", "action_out_proj")
TOWERS = {"vision", "action", "all"}


def run_with(method, folder):
    run = make_run(folder / "run", dataclasses.replace(CONFIG, peft=method, targets=TARGETS))
    if not method.trains_base:
        add_noise(run.policy.model, 0.1)
    return run


def measured(*arguments, **options):
    found = measures(*arguments, **options, **SIZES)
    assert json.loads(json.dumps(found)) == found
    return found


def test_lora_sp(tmp_path):
    run = run_with(CONFIG.peft, tmp_path)
    found = measured(run.policy, run.episodes)
    assert found.keys() == {"gradient_cosine", "rank_boxes", "direction_overlap"}
    pairs = {"press|press", "press|pick_place", "pick_place|pick_place"}
    assert found["gradient_cosine"].keys() == pairs
    assert all(towers.keys() == TOWERS for towers in found["gradient_cosine"].values())
    assert found["direction_overlap"].keys() == {"press|pick_place"}
    for index, chance in found["direction_overlap"]["press|pick_place"].values():
        assert 0 <= chance <= index <= 1
    boxes = found["rank_boxes"]
    assert {
        tower: {n: len(rows) for n, rows in linears.items()} for tower, linears in boxes.items()
    } == {
        "vision": {"fc1": 2},
        "action": {"q_proj": 2, "action_out_proj": 1},
    }
    for box in [*boxes["vision"]["fc1"], *boxes["action"]["q_proj"]]:
        assert len(box) == 5
        assert 0 <= box[0] <= box[2] <= box[4] <= CONFIG.peft.rank
        assert box == sorted(box)


def test_seeds_share_compiled_programs(tmp_path):
    programs, sizes = (directions._count, gradients._gradient), []
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        run = run_with(CONFIG.peft, tmp_path / name)
        measured(run.policy, run.episodes)
        sizes.append([program._cache_size() for program in programs])
    assert sizes[0] == sizes[1]


def test_one_task_has_no_pairs(tmp_path):
    run = run_with(CONFIG.peft, tmp_path)
    assert measured(run.policy, {"press": run.episodes["press"]}).keys() == {"rank_boxes"}


def test_lora_and_its_cut(tmp_path):
    run = run_with(LoRA(rank=4), tmp_path)
    assert measured(run.policy, run.episodes).keys() == {"gradient_cosine"}
    smaller = transforms.cut(run.policy, 1.0)
    found = measured(smaller, run.episodes, source=run.policy)
    assert found.keys() == {"smaller"}
    before, after = found["smaller"]["bytes"]
    assert before == 4 * adaptation.count(run.policy.model).trainable > after


def test_full_fine_tuning(tmp_path):
    base = random_backbone(Pi0Config.dummy())
    run = run_with(FullFineTuning(), tmp_path)
    moved = random_backbone(Pi0Config.dummy(), seed=1)
    policy = Policy(moved, run.policy.processor)
    found = measured(policy, run.episodes, base=base)
    assert found.keys() == {"spectral_rank"}
    assert found["spectral_rank"]["vision"].keys() > {"fc1", "patch_embed"}
    assert all(0 < share <= 1 for share in found["spectral_rank"]["action"]["q_proj"])
    found = measured(run.policy, run.episodes, base=base)  # nothing has learned yet
    assert found["spectral_rank"]["vision"]["fc1"] == [None, None]
    assert "gradient_cosine" in found
