"""The paper's study has the cells of its tables, trained alike."""

import dataclasses
import functools
import re
from collections import Counter
from pathlib import Path

import jax
import numpy as np
import pytest

import envs
from lorasp_jax.config import Config
from lorasp_jax.extras.study import Cell, progress
from lorasp_jax.extras.study import results as files
from lorasp_jax.extras.study.progress import CellState
from lorasp_jax.training import experiment_file, setup
from studies.paper import criteria, published
from studies.paper.claims import make_claims
from studies.paper.study import BACKBONES, RANK
from tests import ROOT

STUDY = experiment_file.call(Path(ROOT / "studies/paper/study.py"), "get_study", "accelerator")
NAMES = [cell.name for cell in STUDY.cells]
CLAIMS = make_claims(NAMES, RANK, BACKBONES)


@functools.cache
def results():
    return files.load(ROOT / "studies/paper/results.json")


@functools.cache
def config(name: str) -> Config:
    cell = STUDY[name]
    assert isinstance(cell, Cell)
    return cell.config if isinstance(cell.config, Config) else cell.config(results())


def test_number_of_cells(capsys):
    counts = Counter(re.sub(r"^[a-z0-9]+/|/[^/]+$", "", name).split("/")[0] for name in NAMES)
    trained = sum(isinstance(cell, Cell) for cell in STUDY.cells)
    with capsys.disabled():
        print(f"\n{len(NAMES)} cells, {trained} trained: {dict(counts)}")
    assert counts == {"pilot": 42, "multi": 117, "single": 192, "panda": 6}
    assert trained == 333


def test_cells_are_those_of_the_results(tmp_path):
    """With the same settings, so that no change of the study goes unnoticed."""
    found = progress.read(dataclasses.replace(STUDY, finished=results()), tmp_path)
    states = {status.state for status in found.values()}
    assert (states, found.keys()) == ({CellState.FINISHED}, results().keys())


def test_the_page_needs_measures_of_policies_for_all_tasks():
    for cell in STUDY.cells:
        if isinstance(cell, Cell):
            assert cell.measured == (cell.name.split("/")[1] in ("multi", "panda")), cell.name


def test_methods_differ_only_in_method_and_rate():
    base = config("pi0/multi/lora_sp/s1")
    for name in NAMES:
        if name.startswith("pi0/multi/") and isinstance(STUDY[name], Cell) and name.endswith("/s1"):
            other = config(name)
            optim = dataclasses.replace(other.optim, learning_rate=base.optim.learning_rate)
            assert dataclasses.replace(other, peft=base.peft, optim=optim) == base


def test_single_tasks_see_as_many_samples():
    multi, single = config("pi0/multi/lora_r8/s2"), config("pi0/single/lora_r8/pour/s2")
    assert (multi.optim.steps, single.optim.steps) == (5000, 1250)
    assert single.tasks == ("pour",)
    assert single.optim.batch_size == multi.optim.batch_size == 128
    assert single.optim.learning_rate == multi.optim.learning_rate


def test_pilots_choose_the_rate_on_other_layouts():
    pilots = [name for name in NAMES if name.startswith("pi0/pilot/dora/")]
    rates = [config(name).optim.learning_rate for name in pilots]
    trained = [name for name in NAMES if isinstance(STUDY[name], Cell) and "pilot" not in name]
    assert config(pilots[0]).seed not in {config(name).seed for name in trained}
    for best, rate in zip(pilots, rates, strict=True):
        outcomes = {True: {"press": "11"}, False: {"press": "10"}}
        found = {name: {"outcomes": outcomes[name == best]} for name in pilots}
        cell = STUDY["pi0/multi/dora/s0"]
        assert cell.config(found).optim.learning_rate == rate


@pytest.mark.parametrize("backbone", ["pi0", "smolvla"])
def test_the_panda_differs_only_in_robot_and_scene(backbone):
    """Its cells come last, so that the others keep their places in shards."""
    assert NAMES[-6:] == [f"{b}/panda/full/s{s}" for b in ("pi0", "smolvla") for s in range(3)]
    for seed in range(3):
        panda, piper = (config(f"{backbone}/{r}/full/s{seed}") for r in ("panda", "multi"))
        assert panda.robot == "panda"
        assert {*panda.scene.changed()} == {
            "camera_position", "camera_turn", "table_height", "position", "turn"
        }  # fmt: skip
        evaluation = dataclasses.replace(panda.evaluation, before=False)
        same = {"robot": "piper", "scene": piper.scene, "evaluation": evaluation}
        assert dataclasses.replace(panda, **same) == piper
        assert piper.ranges is None


def test_seeds_of_a_method_are_one_group():
    for group, cells in STUDY.groups.items():
        assert len({cell.name.split("/")[2] for cell in cells if isinstance(cell, Cell)}) == 1, (
            group
        )


class Recording(dict):
    """Results that record which cells are read."""

    def __init__(self, found):
        super().__init__(found)
        self.read = set()

    def __getitem__(self, name):
        self.read.add(name)
        return super().__getitem__(name)


def test_claims_read_the_cells_that_they_name():
    assert [claim.number for claim in CLAIMS] == list(range(1, 11))
    for test in (t for claim in CLAIMS for tests in claim.tests.values() for t in tests):
        found = Recording(results())
        estimate = criteria.judge(test, found).estimate
        assert found.read == set(test.cells)
        assert estimate.low <= estimate.value <= estimate.high or "deviation" in test.measure


def test_the_papers_numbers():
    """The means that the paper's text and tables give."""
    means = {"pi0/multi/lora_sp": 83.3, "smolvla/single/lora_r64": 91.7, "pi0/multi/lora_r16": 41.7}
    for prefix, mean in means.items():
        assert 100 * published.rates(prefix, 64).mean() == pytest.approx(mean, abs=0.06)
    assert published.rates("pi0/multi/lora_r2", 64) is None


def test_claim_on_ranks_names_those_that_it_averages():
    losses, spreads = (test.measure for test in CLAIMS[3].tests["smolvla"])
    assert "averaged over r = 4, 8, 16, 32: multi" in losses
    assert "averaged over r = 4, 8, 16, 32, 64: multi" in spreads
    cells = CLAIMS[3].tests["smolvla"][0].cells
    assert {name.split("/")[2] for name in cells} == {
        "full",
        *(f"lora_r{2**n}" for n in range(2, 6)),
    }


def test_numbers_know_how_large_they_can_be():
    largest = {t.maximum for claim in CLAIMS for t in claim.tests["smolvla"]}
    assert largest == {1.0, 64.0}
    assert {test.maximum for test in CLAIMS[7].tests["pi0"]} == {64.0}


@pytest.mark.slow
@pytest.mark.parametrize("task", ["open_pot", "pour", "press", "pick_place"])
def test_the_side_camera_sees_all_objects_in_the_new_scene(task):
    ranges = config("pi0/panda/full/s0").ranges
    env = envs.make(task, "panda", num_envs=256, image_size=8, backend="jax")
    state = env.reset(jax.random.key(0), ranges)
    objects = [env.model.body(name).id for name in state.info["layout"]]
    camera = env.cameras.index("side")
    offset = state.data.xpos[:, objects] - state.data.cam_xpos[:, camera, None]
    x, y, z = np.einsum("wji,wbj->iwb", state.data.cam_xmat[:, camera], offset)
    edge = -z * np.tan(np.deg2rad(env.model.cam_fovy[camera] / 2))
    assert np.all(np.maximum(np.abs(x), np.abs(y)) < edge)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", ["lora_sp", "lora_moe_top1", "ada_lora", "full", "dora", "lora_r2"]
)
def test_cells_can_be_built(method, tmp_path):
    for backbone in ("pi0", "smolvla"):
        setup.build(config(f"{backbone}/multi/{method}/s0"), tmp_path, abstract=True)
