"""Forms for one task: made from its demonstrations alone, and served together on one base."""

import dataclasses
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.datasets import rlds
from lorasp_jax.adapters import adaptation
from lorasp_jax.data import cache
from lorasp_jax.data.opening import open_source
from lorasp_jax.extras.deployment import __main__ as command
from lorasp_jax.extras.deployment import healing, measurement, variants
from lorasp_jax.extras.study import held_out, results
from lorasp_jax.peft import LoRA
from lorasp_jax.training import export
from lorasp_jax.training.base import TRAINING
from lorasp_jax.training.finished_run import recorded_config
from lorasp_jax.training.run_folder import read_json, to_json, write_json
from tests.cases import mostly_slow
from tests.extras.deployment.test_deployment import (  # noqa: F401  (a fixture)
    actions,
    episodes,
    finished_run,
    refuse,
)
from tests.extras.serving.adapter_runs import TEXTS, serve_runs
from tests.extras.serving.test_policies import actions as answer
from tests.extras.serving.test_policies import request
from tests.runs import CONFIG, leaves, random_episodes

TASKS = {task: TEXTS[task] for task in ("press", "pour")}


def of_tasks(seed):
    return {
        task: dataclasses.replace(random_episodes(task, seed + i), instructions=phrases)
        for i, (task, phrases) in enumerate(TASKS.items())
    }


OWN, HELD_OUT = of_tasks(1), of_tasks(3)
"""What the run has learned from, and what calibrates."""


@pytest.fixture(scope="module")
def run(tmp_path_factory, dummy_base):
    """A run of two tasks with its demonstrations."""
    root = tmp_path_factory.mktemp("runs")
    folder = finished_run(root / "trained", dummy_base, instructions=TASKS)
    for task, group in OWN.items():
        group.save(folder / f"cache/{task}.npz")
    return folder


@pytest.fixture(autouse=True)
def calibration(monkeypatch, episodes):  # noqa: F811
    """Replace the simulation."""
    some = lambda config, *_: {task: HELD_OUT[task] for task in config.tasks}  # noqa: E731
    monkeypatch.setattr(held_out, "demonstrations", some)
    monkeypatch.setattr(measurement, "_other_demonstrations", some)


def save(run, out, name, task, *more):
    words = [str(run), "--save", name, "--out", str(out), "--task", task, *more]
    assert command.main(words) == 0
    return out


def files(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.parametrize(
    "more",
    mostly_slow([(), ("--heal", "2")], [("--heal", "2")]),
    ids=lambda more: " ".join(more) or "unhealed",
)
def test_loras_of_two_tasks_are_served_on_one_base(run, tmp_path, more):
    saved = {
        task: str(save(run, tmp_path / task, "lora-bf16", task, *more)) for task in reversed(TASKS)
    }
    assert export.describe(saved["pour"])["tasks"] == ["pour"]
    served = serve_runs(saved, route="exact", max_batch=1)
    pour, press = (each.policy.policy.model for each in served.adapters)
    assert [*map(id, pour.base)] == [*map(id, press.base)]
    assert sum(x.nbytes for x in pour.own) < sum(x.nbytes for x in pour.base) / 5
    assert served.instructions == {task: TASKS[task] for task in saved}
    found = {task: answer(served, request(served.spec, 0, TASKS[task][0])) for task in TASKS}
    for task, folder in saved.items():
        policy = export.load_policy(folder)
        assert {type(x) for x in adaptation.methods(policy.model).values()} == {LoRA}
        own = serve_runs({task: folder}, share=False, max_batch=1)
        expected = answer(own, request(own.spec, 0, TASKS[task][0]))
        np.testing.assert_allclose(found[task], expected, atol=1e-4)
    other = dataclasses.replace(request(served.spec, 0, TASKS["press"][0]), adapter="pour")
    assert np.abs(answer(served, other) - found["press"]).max() > 1e-3


@pytest.mark.parametrize(
    "form", mostly_slow(["pruned", "half", "lora", "merged"], ["half", "merged"])
)
def test_the_demonstrations_of_the_task_alone_calibrate(run, tmp_path, form):
    served = export.load_policy(save(run, tmp_path / "policy", f"{form}-bf16", "pour"))
    policy = export.load_policy(run)
    assert served.processor.prompts.instructions == TASKS["pour"]
    made, other, both = (
        variants.in_form(policy, form, {task: HELD_OUT[task] for task in tasks})
        for tasks in (["pour"], ["press"], TASKS)
    )
    row = policy.processor.prompts.rows(TASKS["pour"][:1])[0]
    found, expected = actions(served), sampled(made, row)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    if form != "pruned":  # tasks of random pictures use the same directions
        for wrong in (other, both):
            assert np.abs(sampled(wrong, row) - found).max() > 1e-4


@jax.jit
def sampled(policy, row):
    """As `actions`, with the instruction in a row of the policy's table."""
    images = {name: jnp.ones((1, 32, 32, 3), jnp.uint8) for name in ("side", "wrist")}
    return policy.sample(
        jax.random.key(0), {"image": images, "state": jnp.zeros((1, 7))}, row[None]
    )


def test_the_demonstrations_of_the_task_alone_heal(run, tmp_path, capsys, monkeypatch):
    """Others need not be there; the policy may have the instructions of all."""
    changed, seen = shutil.copytree(run, tmp_path / "run"), []
    (changed / "cache/press.npz").unlink()
    before = files(changed)

    def train(healed):
        seen.append((healed.episodes.keys(), healed.config.tasks, healed.steps))

    monkeypatch.setattr(healing.loop, "train", train)
    policy = export.load_policy(changed)
    healing.heal(policy, changed, 2, task="pour")
    healing.heal(variants._with_instructions(policy, TASKS["pour"]), changed, 2, task="pour")
    states = OWN["pour"].state[np.arange(9) < OWN["pour"].length[:, None]]
    for (tasks, named, steps), rows in zip(seen, ({2, 3}, {0, 1}), strict=True):
        assert ([*tasks], named) == (["pour"], ("pour",))
        np.testing.assert_array_equal(steps.state, states)
        assert set(steps.instruction.tolist()) == rows
    words = changed, "--save", "half-bf16", "--out", tmp_path / "policy", "--heal", 1
    for more in ((), ("--task", "press")):
        assert "some of its demonstrations are gone" in refuse(capsys, *words, *more)
    assert files(changed) == before


@pytest.mark.slow
def test_healing_on_a_task_learns_it(run):
    made = variants.in_form(export.load_policy(run), "half", HELD_OUT)
    half = variants._with_instructions(made, TASKS["pour"])
    healed = healing.heal(half, run, 100, task="pour")
    pour = {"pour": OWN["pour"]}
    assert measurement.mean_loss(healed, pour) < 0.99 * measurement.mean_loss(half, pour)
    frozen = [leaves(adaptation.split(policy.model)[2]) for policy in (half, healed)]
    assert all((x == frozen[1][name]).all() for name, x in frozen[0].items())


def test_what_a_run_replays_must_be_there_too(run, dummy_base, tmp_path):
    """But not to heal it on one of its tasks."""
    base = shutil.copytree(dummy_base, tmp_path / "base")
    taught = {"tasks": ["press", "open_pot"], "robot": "piper", "physics_dt": 0.005}
    write_json(base / TRAINING, taught)
    changed, config = shutil.copytree(run, tmp_path / "run"), read_json(run / "config.json")
    groups = {"data": {"replay": 0.1}, "model": {"checkpoint": str(base)}}
    changes = {name: config[name] | group for name, group in groups.items()}
    write_json(changed / "config.json", config | changes)
    with pytest.raises(ValueError, match="some of its demonstrations are gone"):
        healing.check(changed)
    assert healing.check(changed, "pour").data.replay == 0
    OWN["press"].save(changed / "cache/open_pot.npz")
    assert healing.check(changed).data.replay == 0.1
    source = groups | {"data": {"replay": 0.1, "source": "recorded"}}
    changes = {name: config[name] | group for name, group in source.items()}
    write_json(changed / "config.json", config | changes)
    assert healing.check(changed, "pour").data.replay == 0.1  # a part of the same dataset


def test_forms_keep_what_a_run_protects(run, tmp_path, capsys):
    """Its own data would calibrate a form that says it knows both."""
    changed, config = shutil.copytree(run, tmp_path / "run"), read_json(run / "config.json")
    write_json(changed / "config.json", config | {"protect": "runs/first"})
    error = refuse(capsys, changed, "--save", "half-bf16", "--out", tmp_path / "half")
    assert f"{changed} also knows what runs/first learned, but its own data alone would" in error
    assert not (tmp_path / "half").exists()
    save(changed, tmp_path / "pour", "half-bf16", "pour")
    assert export.load_policy(tmp_path / "pour").processor.prompts.instructions == TASKS["pour"]
    assert command.main([str(changed), "--save", "whole-bf16", "--out", str(tmp_path / "a")]) == 0


def test_variants_are_measured_on_one_task(run, capsys):
    words = [str(run), "--variants", "lora-nf4", "--episodes", "4"]
    assert command.main([*words, "--task", "pour"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1] for line in lines[2:]] == ["whole-bf16", "lora-nf4"]
    found = results.load(run / "deployment/results.json")
    assert found.keys() == {"pour/whole-bf16", "pour/lora-nf4"}
    for cell in found.values():
        assert (cell["config"]["tasks"], [*cell["outcomes"]]) == (["pour"], ["pour"])
    assert command.main(words) == 0
    found = results.load(run / "deployment/results.json")
    assert found["lora-nf4"]["outcomes"].keys() == TASKS.keys()
    assert len(found) == 4
    losses = [found[name]["measures"]["loss"] for name in ("pour/lora-nf4", "lora-nf4")]
    assert losses[0] != losses[1]


def test_refusals(run, tmp_path, capsys):
    out = tmp_path / "policy"
    words = "--save", "lora-bf16", "--out", out
    for more in ((), words):
        error = refuse(capsys, run, "--task", "push", *more)
        assert f"{run} has no task 'push': choose one of press, pour" in error
    assert not out.exists()


@pytest.fixture(scope="module")
def recorded(run, tmp_path_factory):
    """A run that cannot be simulated, which learned from recordings of both tasks, and these."""
    root = tmp_path_factory.mktemp("recorded")
    for task, group in OWN.items():
        rlds.write(group, root / task)
    cache.write([open_source(root / task) for task in OWN], root / "joined", lambda *_: None)
    folder = shutil.copytree(run, root / "run", ignore=shutil.ignore_patterns("cache"))
    config = recorded_config(run)
    data = dataclasses.replace(config.data, source=(str(root / "joined"),), validation=("1",))
    config = dataclasses.replace(config, data=data, tasks=("open_pot",))  # the dataset's count
    write_json(folder / "config.json", to_json(config))
    write_json(folder / "results.json", read_json(run / "results.json") | {"tasks": {}})
    return folder


@pytest.mark.parametrize("task", ["", "pour", TASKS["pour"][0]])
def test_recordings_calibrate_and_heal(recorded, tmp_path, monkeypatch, task):
    """Not simulated demonstrations, nor episodes that are held out, nor those of other tasks."""
    seen = []

    def keep(run, *_):
        seen.append(run)
        return real(run, *_)

    real = variants.activations.sampled
    monkeypatch.setattr(held_out, "demonstrations", None)
    monkeypatch.setattr(variants.activations, "sampled", keep)
    monkeypatch.setattr(healing.loop, "train", seen.append)
    folder = save(recorded, tmp_path / "policy", "lora-bf16", task, "--heal", "2")
    assert len(seen) == 2
    pour = len(OWN["press"].length)  # number of the first episode of pour
    (spared,) = seen[0].held_out
    for run in seen:
        steps, cache = run.steps, run.recordings
        learned = {*cache.episodes[steps.starts].tolist()}
        every = {*range(pour if task else 0, len(cache))} - {spared}
        if task not in ("", *TASKS):  # one of its instructions
            rows = OWN["pour"].instruction
            every &= {pour + n for n in range(len(rows)) if rows[n] == 0}
        assert learned == every
    calibration = export.describe(folder)["calibration"]
    assert calibration == {
        "data": str(recorded.parent / "joined"),
        "episodes": len(learned),
        "frames": int(np.isin(cache.episodes, [*learned]).sum()),
        "windows": 8 * CONFIG.optim.batch_size,
    }
    served = export.load_policy(folder)
    texts = TASKS.get(task, (task,)) if task else (*TASKS["press"], *TASKS["pour"])
    assert {*served.processor.prompts.instructions} == {*texts}


def test_the_form_as_trained_needs_no_data(recorded, tmp_path, capsys):
    changed = shutil.copytree(recorded, tmp_path / "run")
    config = read_json(changed / "config.json")
    gone = config | {"data": config["data"] | {"source": "gone"}}
    write_json(changed / "config.json", gone)
    assert command.main([str(changed), "--save", "whole-int8", "--out", str(tmp_path / "a")]) == 0
    assert capsys.readouterr().out == f"written: {tmp_path / 'a'}\n"
    assert not {"calibration", "healed"} & export.describe(tmp_path / "a").keys()
    error = refuse(capsys, changed, "--save", "half-bf16", "--out", tmp_path / "b")
    assert f"the recordings of {changed} cannot be read: gone does not exist" in error
    error = refuse(capsys, changed, "--save", "half-bf16", "--out", tmp_path / "b", "--task", "x")
    assert "has no task 'x': choose one of press, pour, or one of its instructions" in error


def test_refusals_of_recordings(recorded, tmp_path, capsys):
    words = "--save", "lora-bf16", "--out", tmp_path / "policy"
    error = refuse(capsys, recorded)
    assert f"the tasks of {recorded} cannot be simulated: make a variant with --save" in error
    changed, path = shutil.copytree(recorded, tmp_path / "run"), "adapter.json"
    with pytest.raises(ValueError, match="run trained on no episode of push"):
        healing.heal(export.load_policy(changed), changed, 1, task="push")
    described = read_json(changed / path)
    described["metadata"]["policy"]["datasets"] = {"a": {}, "b": {}}
    write_json(changed / path, described)
    for more in ((), ("--heal", 1)):
        error = refuse(capsys, changed, *words, *more)
        assert (
            "have statistics or cameras of their own: a form of its policy would act for a" in error
        )
    assert not (tmp_path / "policy").exists()
