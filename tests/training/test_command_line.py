"""Every method trains from the command line on both backbones; configs of published sizes parse."""

import functools
from pathlib import Path

import jax
import numpy as np
import pytest

from lorasp_jax import peft
from lorasp_jax.cli import train
from lorasp_jax.models import backbone
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.overrides import parse
from lorasp_jax.training.run_folder import read_metrics
from tests import ROOT

COMMAND = [
    *("--config", f"{ROOT}/configs/multitask.py", "--scale", "smoke", "--tasks", "press"),
    *("--targets", "paper", "--optim.batch-size", "8"),
]


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory):
    """A cache folder that the first run fills and the others read."""
    return tmp_path_factory.mktemp("demonstrations")


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", backbone.names())
@pytest.mark.parametrize("method", peft.names())
def test_twenty_steps(name, method, demonstrations, tmp_path, monkeypatch):
    from lorasp_jax.training import demonstrations as collected
    from lorasp_jax.training import setup

    collect = lambda c, _, p: collected.demonstrations(c, demonstrations, p)  # noqa: E731
    monkeypatch.setattr(setup, "prepare", functools.partial(setup.prepare, collect=collect))
    monkeypatch.setattr(meshes, "make_mesh", one_device(meshes.make_mesh))
    monkeypatch.chdir(tmp_path)
    options = ["--model.backbone", name, "--method", method]
    assert train.main([*COMMAND, *options, "--optim.steps", "20"]) == 0
    rows = read_metrics(Path("runs/multitask"))
    assert rows[-1]["step"] == 20
    assert all(np.isfinite(row["loss"]) for row in rows)
    assert Path("runs/multitask/report.html").exists()


def one_device(make):
    """Use one device, which compiles in a quarter of the time."""
    return lambda fsdp, _=None: make(fsdp, jax.devices()[:1])


@pytest.mark.parametrize("name", backbone.names())
def test_published_models_have_their_own_configs(name):
    config = parse(["--config", f"{ROOT}/configs/multitask_{name}.py", "--scale", "smoke"]).config
    assert (config.model.backbone, config.model.size) == (name, "base")
    assert config.targets == ("paper",)
    assert isinstance(config.peft, peft.LoRASP)
    assert config.evaluation.execute_steps <= backbone.find(name).base().chunk


def test_a_task_is_chosen_by_name():
    config = parse(["--config", f"{ROOT}/configs/single_task.py", "--tasks", "pour"]).config
    assert config.tasks == ("pour",)
    assert config.peft == parse(["--config", f"{ROOT}/configs/multitask.py"]).config.peft


@pytest.mark.slow
@pytest.mark.parametrize("version", ["v21", "v3"])
def test_a_lerobot_dataset(version, tmp_path, monkeypatch):
    """Train adapters on LeRobot files, without simulation."""
    monkeypatch.setattr(meshes, "make_mesh", one_device(meshes.make_mesh))
    monkeypatch.chdir(tmp_path)
    source = str(ROOT / "tests" / "golden" / f"lerobot_{version}" / "dataset")
    options = ["--model.max-tokens", "16", "--data.source", source]
    command = [x for x in COMMAND if x not in ("--tasks", "press")]
    assert train.main([*command, *options, "--optim.steps", "20"]) == 0
    first, *_, last = read_metrics(Path("runs/multitask"))
    assert last["task"] < first["task"]
    for name in ("report.html", "adapter.safetensors", "cache/steps/cache.json"):
        assert Path("runs/multitask", name).stat().st_size
