"""A dry run says what the run will need, and leaves nothing behind."""

import dataclasses
from types import SimpleNamespace

import jax
import pytest
from flax import nnx
from rich.console import Console

from envs.compilation import messages
from lorasp_jax.adapters import adaptation
from lorasp_jax.cli import train
from lorasp_jax.config import DataConfig
from lorasp_jax.data.batches import Raw, flatten
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import LoRA
from lorasp_jax.storage import hub
from lorasp_jax.training import setup
from lorasp_jax.training.cost import dry_run, preflight
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.overrides import Command, load
from lorasp_jax.training.run import Run
from tests import ROOT
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, random_episodes

LIMIT, EPISODES = 50, 6


@pytest.fixture
def config(monkeypatch):
    """No simulation, the dummy backbone, one device."""
    world = SimpleNamespace(
        instructions=random_episodes("", 0).instructions,
        robot=SimpleNamespace(num_joints=6),
        cameras=("side", "wrist"),
        max_steps=LIMIT,
    )
    mesh = meshes.make_mesh(1, jax.devices()[:1])
    monkeypatch.setattr(meshes, "make_mesh", lambda *_: mesh)
    monkeypatch.setattr(setup.envs, "make", lambda *_, **__: world)
    monkeypatch.setattr(
        setup, "base_model", lambda *_, **__: (random_backbone(Pi0Config.dummy()), "")
    )
    monkeypatch.setattr(setup, "demonstrations", lambda *_: pytest.fail("it collects"))
    evaluation = dataclasses.replace(CONFIG.evaluation, execute_steps=1)
    data = DataConfig(episodes=EPISODES)
    method = LoRA(rank=4)  # traces and compiles faster than others
    return dataclasses.replace(
        CONFIG, peft=method, targets=("action_out_proj",), evaluation=evaluation, data=data
    )


def test_what_is_printed_is_what_the_program_takes(config, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(preflight, "MIB", 1)
    monkeypatch.setattr(messages, "PATIENCE", 0.0)
    built, build = [], setup.build
    monkeypatch.setattr(setup, "build", lambda *a, **k: built.append(build(*a, **k)) or built[0])
    monkeypatch.setattr(train, "Console", lambda **_: Console(width=150))
    monkeypatch.setattr(
        "lorasp_jax.training.overrides.parse", lambda *_: Command(config, dry_run=True)
    )
    assert train.main([]) == 0
    assert not list(tmp_path.iterdir())
    printed, told = capsys.readouterr()
    assert told.startswith("compiling the training step")  # before it waits, in a pipe too
    rows = [line.replace(",", "").strip("│ ").split() for line in printed.splitlines()]
    table = {row[0]: [cell for cell in row[1:] if cell != "│"] for row in rows if row}
    one = sum(x[:1].nbytes for x in jax.tree.leaves(flatten([random_episodes("", 0)])))
    steps = len(config.tasks) * LIMIT * EPISODES
    assert float(table["demonstrations"][0]) == steps * one
    expected, compiled = map(float, table["arguments"])
    assert compiled == pytest.approx(expected, rel=0.02)
    assert float(table["peak"][1]) > compiled > steps * one
    trained, total = adaptation.count(built[0].model)
    assert [int(number) for number in table["all"][:2]] == [total, trained]
    assert "TFLOP" in printed


@pytest.mark.parametrize("file", ["multitask_pi0", "multitask_smolvla"])
def test_published_models_need_no_download(file, monkeypatch):
    """Their shapes suffice."""
    for place in ("_from_hub", "_from_bucket"):
        monkeypatch.setattr(hub, place, lambda *_: pytest.fail("it downloads"))
    config = load(ROOT / "configs" / f"{file}.py", "smoke")
    assert all(hub.is_remote(x) for x in (config.model.source, config.model.tokenizer))
    model = dataclasses.replace(config.model, size="nano")
    optim = dataclasses.replace(config.optim, batch_size=jax.device_count())
    config = dataclasses.replace(config, model=model, optim=optim, tasks=("press",))
    config = dataclasses.replace(
        config, evaluation=dataclasses.replace(config.evaluation, execute_steps=1)
    )
    built = setup.build(config, ROOT / "nowhere", shapes=True)
    leaves = jax.tree.leaves(nnx.state(built.model, nnx.Param))
    assert {type(leaf) for leaf in leaves} == {jax.ShapeDtypeStruct}
    assert adaptation.count(built.model).trainable > 0


def test_a_dataset_without_room_streams(config, tmp_path):
    """Then a step is given a batch."""
    random_episodes("press", 0).save(tmp_path / "press.npz")
    config = dataclasses.replace(config, data=DataConfig(source=str(tmp_path / "press.npz")))
    built = setup.build(config, tmp_path)
    run = Run(config, tmp_path, Console(), "")
    for room, count in ((1e12, random_episodes("", 0).num_steps), (1.0, config.optim.batch_size)):
        there = dataclasses.replace(built, available=built.memory.peak + room)
        data = dry_run._prepared(run, there)
        assert isinstance(data, Raw) == (room == 1)
        assert data.state.shape == (count, 7)
        assert data.image["side"].shape == (count, 32, 32, 3)
