"""A dry run prints the cost of a run and writes nothing."""

import dataclasses
import re
from types import SimpleNamespace

import jax
import pytest
from flax import nnx
from rich.console import Console

from envs.datasets import rlds
from lorasp_jax.adapters import adaptation
from lorasp_jax.base import hub, messages
from lorasp_jax.config import DataConfig
from lorasp_jax.data.batches import flatten, nbytes
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import LoRA
from lorasp_jax.training import early, setup
from lorasp_jax.training.cost import dry_run, preflight
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.overrides import load
from lorasp_jax.training.run import Run
from tests import ROOT
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, random_episodes

LIMIT, EPISODES = 50, 6


@pytest.fixture
def config(monkeypatch):
    """A config for one device, without simulation."""
    env = SimpleNamespace(
        instructions=random_episodes("", 0).instructions,
        robot=SimpleNamespace(num_joints=6),
        cameras=("side", "wrist"),
        max_steps=LIMIT,
    )
    mesh = meshes.make_mesh(1, jax.devices()[:1])
    monkeypatch.setattr(meshes, "make_mesh", lambda *_: mesh)
    monkeypatch.setattr(setup.envs, "make", lambda *_, **__: env)
    base = random_backbone(Pi0Config.dummy()), ""
    monkeypatch.setattr(setup, "base_model", lambda *_, **__: base)
    evaluation = dataclasses.replace(CONFIG.evaluation, execute_steps=1)
    data = DataConfig(episodes=EPISODES)
    method = LoRA(rank=4)  # traces and compiles faster than others
    return dataclasses.replace(
        CONFIG, peft=method, targets=("action_out_proj",), evaluation=evaluation, data=data
    )


def test_the_printed_memory_is_that_of_the_compiled_program(config, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(preflight, "MIB", 1)
    monkeypatch.setattr(messages, "PATIENCE", 0.0)
    dry_run.dry_run(config, tmp_path, Console(width=150))
    assert not list(tmp_path.iterdir())
    printed, errors = capsys.readouterr()
    assert errors.startswith("compiling the training step")  # at once, even in a pipe
    memory = {
        line.partition(" per device, ")[2].partition(":")[0]: {
            part: float(value) for part, value in re.findall(r"([a-z]+) ([\d.]+)", line)
        }
        for line in printed.splitlines()
        if line.startswith("memory")
    }
    estimated, compiled = memory["estimated"], memory["compiled"]
    step_bytes = sum(x[:1].nbytes for x in jax.tree.leaves(flatten([random_episodes("", 0)])))
    assert compiled["dataset"] == len(config.tasks) * LIMIT * EPISODES * step_bytes
    optim = config.optim
    batches = min(config.log_every, optim.steps) * optim.batch_size  # of one call
    state = sum(estimated[name] for name in ("base", "adapters", "optimizer"))
    # Chunks have several actions.
    assert batches * step_bytes < compiled["arguments"] - 0.98 * state
    assert compiled["arguments"] < 1.02 * state + 2 * batches * step_bytes
    assert compiled["peak"] > compiled["arguments"] + compiled["dataset"]
    trained, total = adaptation.count(preflight.abstract_model(config, Pi0Config.dummy()))
    assert f"({trained:,} of {total:,})" in printed
    assert "TFLOP" in printed


@pytest.mark.parametrize("file", ["multitask_pi0", "multitask_pi05", "multitask_smolvla"])
def test_published_models_need_no_download(file, monkeypatch):
    for download in ("_from_hub", "_from_bucket"):
        monkeypatch.setattr(hub, download, lambda *_: pytest.fail("it downloads"))
    remat = "none", preflight.Memory(*6 * [0.0])
    monkeypatch.setattr(preflight, "choose_remat", lambda *_: remat)
    config = load(ROOT / "configs" / f"{file}.py", "smoke")
    assert all(hub.is_remote(x) for x in (config.model.source, config.model.tokenizer))
    model = dataclasses.replace(config.model, size=config.model.size.replace("base", "nano"))
    optim = dataclasses.replace(config.optim, batch_size=jax.device_count())
    config = dataclasses.replace(config, model=model, optim=optim, tasks=("press",))
    config = dataclasses.replace(
        config, evaluation=dataclasses.replace(config.evaluation, execute_steps=1)
    )
    built = setup.build(config, ROOT / "nowhere", abstract=True)
    leaves = jax.tree.leaves(nnx.state(built.model, nnx.Param))
    assert {type(leaf) for leaf in leaves} == {jax.ShapeDtypeStruct}
    assert adaptation.count(built.model).trainable > 0
    assert getattr(built.model.config, "pi05", False) == (file == "multitask_pi05")


def test_recordings_change_their_images_as_in_the_run(config, tmp_path, monkeypatch):
    """Simulated episodes do not, by default."""
    seen = []
    monkeypatch.setattr(early, "compile_steps", lambda run, *_: seen.append(run) or 1 / 0)
    for number, physics_dt in enumerate((0.005, 0.0)):
        path = tmp_path / str(number)
        rlds.write(dataclasses.replace(random_episodes("press", 0), physics_dt=physics_dt), path)
        changed = dataclasses.replace(config, data=DataConfig(source=str(path)))
        with pytest.raises(ZeroDivisionError):
            dry_run.dry_run(changed, tmp_path / "run", Console(quiet=True))
    assert [bool(run.augmentation) for run in seen] == [False, True]


def test_a_dataset_larger_than_the_free_memory_streams(config, tmp_path):
    """Each call then takes a single batch, and no dataset is on the device."""
    rlds.write(random_episodes("press", 0), tmp_path / "rlds")
    config = dataclasses.replace(config, data=DataConfig(source=str(tmp_path / "rlds")))
    built = setup.build(config, tmp_path)
    run = Run(config, tmp_path, Console(), "")
    whole = nbytes(flatten([random_episodes("press", 0)]))
    for free, bytes_held, steps in ((1e12, whole, config.log_every), (1.0, 0, 1)):
        device = dataclasses.replace(built, free_bytes=free)
        held, batches = early.data_shapes(run, device)
        assert held == bytes_held
        assert batches.state.shape == (steps, config.optim.batch_size, 7)
        assert batches.image["side"].shape == (steps, config.optim.batch_size, 32, 32, 3)


def test_a_plan_and_its_run_hold_or_stream_the_dataset_alike(config, tmp_path):
    """A budget is below what the device has, and is for evaluating, too."""
    rlds.write(random_episodes("press", 0), tmp_path / "rlds")
    config = dataclasses.replace(config, data=DataConfig(source=str(tmp_path / "rlds")))
    console, whole = Console(quiet=True), nbytes(flatten([random_episodes("press", 0)]))
    memory = setup.build(config, tmp_path).memory.peak
    evaluating = preflight.sampling_peak(config, Pi0Config.dummy())
    needed = max(memory, evaluating) + whole
    for budget, held in ((needed + 1, whole), (needed - 1, 0)):
        assert dry_run.plan_step(config, tmp_path / "plan", console, budget)[1] == held
        folder = tmp_path / str(held)
        folder.mkdir()
        run = setup.prepare(config, folder, console, 0.0, budget=budget)
        assert run.streams == (not held)
