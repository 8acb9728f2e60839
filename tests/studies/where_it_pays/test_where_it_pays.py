"""The study of where adaptive rank pays: its cells, their plans, and its page."""

import numpy as np
import pytest

from lorasp_jax.config import Config
from lorasp_jax.extras.study import Derived, statistics
from lorasp_jax.training import rules
from studies.where_it_pays import page, study

STUDY = study.get_study("accelerator")
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


@pytest.fixture(scope="module")
def results():
    """Results of all policies, of which those at the higher rate are the best."""
    found = {}
    for cell in STUDY.cells:
        rate = 0.5 + 0.2 * cell.name.endswith("0.003")
        text = "1" * round(40 * rate) + "0" * (40 - round(40 * rate))
        outcomes = {f"{s}/{t}": text for s in page.SCENES for t in ("press", "pour")}
        backbone = cell.name.split("/")[0]
        measures = {"trainable_parameters": 1000, "layer_active_rank": active(backbone)}
        found[cell.name] = {"outcomes": outcomes, **measures}
    return found


def test_policies_differ_in_what_their_names_say(results):
    for cell in STUDY.cells:
        backbone, method, rank, seed = cell.name.split("/")
        if method == "pilot":
            continue
        if isinstance(cell, Derived):
            assert cell.source == f"{backbone}/lora/r64/{seed}"
            continue
        config = cell.config if isinstance(cell.config, Config) else cell.config(results)
        assert config.model.backbone == backbone
        assert f"s{config.seed}" == seed
        assert config.optim.learning_rate == 3e-3
        assert bool(config.plan) == (method not in ("lora", "lora_sp", "ada_lora", "eva"))
        named = config.peft.target_rank if method == "ada_lora" else config.peft.rank
        assert f"r{named}" == rank


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
        numbers = "50.0 [" in blocks["pi0 ranks"].replace("\u00a0", " ")
        assert numbers == bool(found)
        assert len(blocks["smolvla layers"].splitlines()) == 2 + len(page.ALLOCATED)
