import dataclasses
import hashlib
import os
import random
import shutil
import subprocess
import sys
import threading
import time

import pytest
from rich.console import Console

from envs.datasets.episodes import Episodes
from envs.scene.ranges import Randomization
from lorasp_jax.config import AugmentConfig
from lorasp_jax.extras.study import held_out, results, run_cell
from lorasp_jax.extras.study.held_out import EPISODES, SEED
from lorasp_jax.extras.study.provenance import provenance
from lorasp_jax.extras.study.runner import Job
from lorasp_jax.extras.study.study import Cell
from lorasp_jax.training.run import Run
from lorasp_jax.training.run_folder import write_json
from tests import ROOT
from tests.extras.study.fakes import CONFIG
from tests.runs import random_episodes

UNREPEATABLE = {"seconds", "speed"}


@pytest.fixture
def collected(monkeypatch):
    """Configs for which demonstrations were collected."""
    configs = []

    def demonstrations(config, folder, progress=None):
        (task,) = config.tasks
        path = folder / "cache" / f"{task}.npz"
        if path.exists():
            return {task: Episodes.load(path, control_dt=config.control_dt)}
        configs.append(config)
        time.sleep(0.05)
        path.parent.mkdir(parents=True, exist_ok=True)
        random_episodes(task, len(configs)).save(path)
        return {task: Episodes.load(path, control_dt=config.control_dt)}

    monkeypatch.setattr(held_out, "demonstrations", demonstrations)
    return configs


def load(folder, **changes):
    config = dataclasses.replace(CONFIG, **changes)
    return held_out.shared_demonstrations(folder, 0, config)


def test_cells_share_demonstrations(tmp_path, collected):
    first = load(tmp_path, tasks=("press", "pour"), seed=0)
    assert list(first) == ["press", "pour"]
    single = load(tmp_path, tasks=("pour",), seed=7, log_every=3)
    assert (single["pour"].state == first["pour"].state).all()
    assert sorted(config.tasks for config in collected) == [("pour",), ("press",)]
    assert {config.seed for config in collected} == {0}


@pytest.mark.parametrize("measured", [True, False])
def test_what_a_study_measures_and_how_a_cell_is_evaluated(tmp_path, monkeypatch, measured):
    run, callbacks = Run(CONFIG, tmp_path, Console(quiet=True), ""), []
    (tmp_path / "a").mkdir()
    monkeypatch.setattr(run_cell.setup, "prepare", lambda *_, **__: run)
    monkeypatch.setattr(run_cell.loop, "train", lambda _, used, **__: callbacks.extend(used))
    monkeypatch.setattr(run_cell, "held_out_demonstrations", lambda *_: {"press": 1})
    measure = lambda run, episodes, source: {"measures": [episodes, source]}  # noqa: E731
    cell = Cell("a", CONFIG, evaluate=lambda run: {"outcomes": {"press": "01"}})
    found = run_cell.run_cell(Job(cell, CONFIG, tmp_path, {}, measure if measured else None))
    assert found.pop("seconds").keys() >= {"evaluate", "total"}
    assert found.pop("provenance") == provenance()
    expected = {"measures": [{"press": 1}, None]} if measured else {}
    assert found == {"outcomes": {"press": "01"}} | expected
    assert [type(callback).__name__ for callback in callbacks] == ["Export"]


def test_only_the_measure_runs_after_it_was_killed(tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    run, calls = Run(CONFIG, tmp_path / "a", Console(quiet=True), ""), []
    monkeypatch.setattr(run_cell.setup, "prepare", lambda *_, **__: run)
    monkeypatch.setattr(run_cell.loop, "train", lambda _, used, **__: calls.append(len(used)))
    monkeypatch.setattr(run_cell, "held_out_demonstrations", lambda *_: {})

    def evaluate(run):
        calls.append("evaluate")
        return {"outcomes": {"press": "01"}}

    def killed(*_):
        raise KeyboardInterrupt

    cell = Cell("a", CONFIG, evaluate=evaluate)
    job = Job(cell, dataclasses.replace(CONFIG, name="a"), tmp_path, {}, killed)
    with pytest.raises(KeyboardInterrupt):
        run_cell.run_cell(job)
    assert calls == [1, "evaluate"]
    job = dataclasses.replace(job, measure=lambda *_: {"speed": 3})
    found = run_cell.run_cell(job)
    assert calls == [1, "evaluate", 0]
    assert (found["outcomes"], found["speed"]) == ({"press": "01"}, 3)
    other = dataclasses.replace(job, config=dataclasses.replace(job.config, seed=1))
    assert run_cell._evaluated(job)
    assert not run_cell._evaluated(other)


def test_rows_that_the_device_computes_wrongly_fail_the_cell(tmp_path):
    run = Run(CONFIG, tmp_path, Console(quiet=True), "")
    after = {"success": 0.5, "episodes": 64, "ci95": [0.4, 0.6], "outcomes": "10" * 32}
    tree = {
        **{"scale": "smoke", "seconds": {}, "tasks": {"press": {"after": after}}},
        **{"active_rank": {}, "layer_active_rank": {}, "active_rank_histogram": {}},
        **{"trainable_parameters": 1, "total_parameters": 2},
    }
    write_json(tmp_path / "results.json", tree)
    with pytest.raises(ValueError, match="success depends on bit 0 of an episode's index"):
        run_cell.simulated(run)


@pytest.mark.parametrize(
    "changes",
    [
        {"robot": "panda"},
        {"image_size": 32},
        {"control_dt": 0.05},
        {"scene": Randomization(turn=(0.0, 0.1))},
        {"data": dataclasses.replace(CONFIG.data, episodes=3)},
    ],
)
def test_other_settings_need_other_demonstrations(tmp_path, collected, changes):
    load(tmp_path, tasks=("press",))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Episodes, "load", lambda path, control_dt: path)
        load(tmp_path, tasks=("press",), **changes)
    assert len(collected) == 2


def test_the_folder_of_demonstrations_keeps_its_name(tmp_path, collected):
    load(tmp_path, tasks=("press",))
    assert [path.name for path in (tmp_path / "demonstrations").iterdir()] == ["piper_caef2654"]


def test_each_seed_takes_its_own_demonstrations_from_a_pool(tmp_path, monkeypatch):
    settings = []

    def demonstrations(config, *_):
        settings.append((config.seed, config.data.episodes, config.data.augment.preset))
        return {task: random_episodes(task, 0) for task in config.tasks}

    monkeypatch.setattr(held_out, "demonstrations", demonstrations)

    def taken(count, seed, preset="none"):
        data = dataclasses.replace(CONFIG.data, episodes=count, augment=AugmentConfig(preset))
        config = dataclasses.replace(CONFIG, data=data, seed=seed, tasks=("press", "pour"))
        found = held_out.shared_demonstrations(tmp_path, 3, config)
        return {task: episodes.state[:, 0].tolist() for task, episodes in found.items()}

    pool, two = taken(3, 0), taken(2, 0)
    for task, states in two.items():
        assert len(states) == 2
        assert all(state in pool[task] for state in states)
    assert all(state in two["press"] for state in taken(1, 0, "openpi")["press"])
    assert two == taken(2, 0)
    assert any(taken(1, seed) != taken(1, 0) for seed in range(1, 9))
    assert {*settings} == {(0, 3, "auto")}  # collected alike, whatever the cell


def test_cells_at_the_same_time_collect_once(tmp_path, collected):
    threads = [
        threading.Thread(target=load, args=(tmp_path,), kwargs={"tasks": ("press",)})
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(collected) == 1


def test_held_out_demonstrations_are_others(tmp_path, collected):
    held_out.held_out_demonstrations(tmp_path, dataclasses.replace(CONFIG, tasks=("press",)))
    load(tmp_path, tasks=("press",))
    assert [config.seed for config in collected] == [SEED, 0]
    assert [config.data.episodes for config in collected] == [EPISODES, CONFIG.data.episodes]


def command(out, *options):
    file = ROOT / "tests/extras/study/smoke.py"
    arguments = ["--config", file, "--scale", "smoke", "--out", out, *options]
    return [sys.executable, "-m", "lorasp_jax.extras.study", *map(str, arguments)]


def run_with_kills(out, delays, *options, code=0):
    """Run a study to its end, after killing it at the given times [s] after each start."""
    settings = {"cwd": ROOT, "env": {**os.environ, "XLA_FLAGS": ""}}  # one device
    with (out.parent / f"{out.name}.txt").open("a") as log:
        settings |= {"stdout": log, "stderr": log}
        for delay in delays:
            process = subprocess.Popen(command(out, *options), **settings)
            try:
                process.wait(delay)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        assert subprocess.run(command(out, *options), check=False, **settings).returncode == code


def repeatable(folder):
    """Return what a study's cells measured, and digests of their policies."""
    found = {}
    for name, cell in results.load(folder / "results.json").items():
        found[name] = {key: value for key, value in cell.items() if key not in UNREPEATABLE}
        if (file := folder / name / "adapter.safetensors").exists():
            found[name]["policy"] = hashlib.sha256(file.read_bytes()).hexdigest()
    return found


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_killed_sharded_and_merged_studies_give_the_same_results(tmp_path):
    run_with_kills(tmp_path / "whole", [])
    whole = repeatable(tmp_path / "whole/tiny")
    assert sorted(whole) == ["lora/s0", "lora/s1", "lora_sp/s0", "lora_sp/s1", "same/s0"]
    assert whole["same/s0"]["outcomes"] == whole["lora_sp/s0"]["outcomes"]
    assert len({cell["policy"] for cell in whole.values() if "policy" in cell}) == 4
    assert {*"".join(cell["outcomes"]["press"] for cell in whole.values())} == {"0", "1"}

    times, merged = random.Random(0), tmp_path / "merged"
    for index, kills in ((1, 2), (2, 1)):
        out = tmp_path / f"shard_{index}"
        for shared in ("demonstrations", "held_out"):
            shutil.copytree(tmp_path / "whole/tiny" / shared, out / "tiny" / shared)
        run_with_kills(out, [times.uniform(5, 30) for _ in range(kills)], "--shard", f"{index}/2")
        shutil.copytree(out, merged, dirs_exist_ok=True)
    run_with_kills(merged, [])
    assert repeatable(merged / "tiny") == whole
    assert not list(merged.rglob("checkpoints"))

    damaged = merged / "tiny/lora/s0/cell.json"
    damaged.write_text(damaged.read_text().replace("1", "0", 1))
    run_with_kills(merged, [], code=2)
    assert f"lora/s0: damaged {damaged}" in (tmp_path / "merged.txt").read_text()
    assert repeatable(merged / "tiny") == {n: cell for n, cell in whole.items() if n != "lora/s0"}
