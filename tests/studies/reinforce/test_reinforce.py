"""The study of learning from success: its cells, and what its page makes of results."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import pytest

from lorasp_jax.extras.study import Derived, statistics
from lorasp_jax.reinforce import start
from lorasp_jax.training.finished_run import recorded_config
from studies.few.judge import SHIFT
from studies.reinforce import page, study
from tests.runs import finish_with_weights

STUDY = study.get_study("accelerator")
N = 40


def outcomes(rate):
    return {task: "1" * round(N * rate) + "0" * (N - round(N * rate)) for task in page.TASKS}


def result(cell):
    """Results in which learning takes every policy from 40 to 80 %."""
    if not isinstance(cell, Derived):
        return {"outcomes": outcomes(0.4), "seconds": {"total": 120.0}}
    rows = [
        {"step": i, "minutes": 2.0 * i, "environment_steps": 1e6 * i}
        | {f"success/{task}": 0.5 for task in page.TASKS}
        | {f"active_rank/{module}": 8.0 * i for module in ("vision", "language", "action")}
        for i in (1, 2)
    ]
    shifted = {f"{when}/{task}": "0111" * 10 for when in ("before", "after") for task in page.TASKS}
    found = {"outcomes": outcomes(0.8), "before": outcomes(0.4), "progress": rows}
    return {**found, "shifted": shifted}


@pytest.fixture(autouse=True)
def few_draws(monkeypatch):
    monkeypatch.setattr(statistics, "DRAWS", 50)
    monkeypatch.setattr(statistics, "_counts", statistics._counts.__wrapped__)


def test_policies_learn_as_their_names_say(monkeypatch):
    monkeypatch.setattr(start, "resolve", lambda config, _: config)
    for cell in STUDY.cells:
        backbone, count, name, seed = cell.name.split("/")
        if not isinstance(cell, Derived):
            assert cell.pool == (0 if cell.config.seed == page.PILOT_SEED else page.CEILING)
            assert (cell.config.model.backbone, f"n{cell.config.data.episodes}") == (
                backbone,
                count,
            )
            assert f"s{cell.config.seed}" == seed
            continue
        assert cell.source == f"{backbone}/{count}/start/{seed}"
        if offline := cell.settings.get("offline"):
            assert name == f"{offline['learn']}_{offline['episodes']}"
            continue
        recorded = cell.settings["trial"]["learning"].get("exploration")
        assert recorded == ("sde" if name == "ppo_sde" else None)  # as in older results
        trial = cell.evaluate.keywords["trial"]
        run = SimpleNamespace(config=STUDY[cell.source].config, folder=Path("runs", cell.name))
        config = trial.config(run)
        assert config.online.start == f"runs/{cell.source}"
        noise, _, episodes = name.partition("_")
        assert config.online.method == (noise if noise in ("noise", "ppo") else "teacher")
        if noise == "noise":
            assert config.tasks == (page.OWNED,)
            assert config.online.worlds * config.optim.steps == int(episodes)
        assert (config.tasks == page.HARD) == (name == "some")
        assert (config.online.adapters == "merge") == (name in page.RANKS)
        assert config.scene.changed() == (SHIFT.changed() if name == "randomized" else {})
        assert config.peft == study.METHODS.get(name, run.config.peft)
        assert cell.settings["trial"].get("name") == (
            study.METHODS[name].name if name in study.METHODS else None
        )


@pytest.mark.parametrize("name", ["teacher", "randomized", "r4", "noise_50", "ppo_sde"])
def test_a_finished_run_can_be_learned_further(name, tmp_path):
    folder = tmp_path / "pi0" / "n16" / "start" / "s0"
    folder.parent.mkdir(parents=True)
    finish_with_weights(folder)
    seed = page.PILOT_SEED if name in study.PILOTS else 0
    trial = STUDY[f"pi0/n16/{name}/s{seed}"].evaluate.keywords["trial"]
    if trial.tasks:
        trial = dataclasses.replace(trial, tasks=("press",))
    run = SimpleNamespace(config=recorded_config(folder), folder=folder.parents[1] / name / "s0")
    config = trial.config(run)
    assert (config.tasks, config.online.start) == (("press",), str(folder))
    assert config.scene.changed() == (SHIFT.changed() if name == "randomized" else {})


def test_no_pilot_is_in_a_table(tmp_path):
    every = {cell.name: result(cell) for cell in STUDY.cells}
    tabled = {name: x for name, x in every.items() if f"/s{page.PILOT_SEED}" not in name}
    assert len(tabled) == len(every) - 2 * (1 + len(study.PILOTS))
    made = [page.blocks(STUDY, results, tmp_path) for results in (every, tabled)]
    pilots = [blocks.pop("pilots") for blocks in made]
    assert made[0] == made[1]
    assert [table.count("80.0") for table in pilots] == [4 * len(study.PILOTS), 0]


def test_page(tmp_path):
    found = {cell.name: result(cell) for cell in STUDY.cells}
    del found["pi0/n32/teacher/s1"]
    made = page.blocks(STUDY, found, tmp_path)
    rows = [line.split(" | ") for line in made["success"].splitlines()[2:]]
    assert [row[2] for row in rows[:3]] == ["3", "2", "3"]
    shown = [cell.split()[0] for cell in rows[0][3:]]
    assert shown == ["40.0", "80.0", "40.0", "80.0", "2.0", "4"]
    gains = made["tasks"].splitlines()[2].split(" | ")
    assert [cell.split()[0] for cell in gains[2:]] == 4 * ["+40.0"]
    scenes = [line.split(" | ")[3:] for line in made["scenes"].splitlines()[2:5]]
    rates = [[cell.split()[0] for cell in row] for row in scenes]
    assert rates == [["40.0", "75.0"], ["80.0", "75.0"], ["80.0", "75.0"]]
    assert made["forgetting"].count("+40.0") == 2 * len(page.TASKS)
    assert made["owner"].count("80.0") == 2 * (1 + 3 * len(page.EPISODES))
    assert made["ranks"].count("80.0") == 2 * 2 * len(page.RANKS)
    assert (tmp_path / "progress.svg").stat().st_size


def test_page_of_nothing(tmp_path):
    made = page.blocks(STUDY, {}, tmp_path)
    assert made["success"].count("| 0 |") == 2 * (len(page.COUNTS) + 1)
