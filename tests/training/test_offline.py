"""Learning from episodes of which half took a wrong action and failed."""

import dataclasses
import io
import time

import jax
import numpy as np
import pytest
from rich.console import Console

from envs.datasets import rlds
from envs.datasets.episodes import Episodes
from lorasp_jax.config import DataConfig
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig
from lorasp_jax.peft import LoRA
from lorasp_jax.training import advantage, setup
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.loop import train
from tests.cases import mostly_slow
from tests.models.random_models import random_backbone
from tests.runs import CONFIG

EPISODES, STEPS = 40, 6
BACKBONES = {"pi0": Pi0Config, "smolvla": SmolVLAConfig}


def fork():
    """From the same place, every other episode goes left and fails, or right and succeeds."""
    right = np.arange(EPISODES) % 2 == 0
    goal = np.where(right, 1.0, -1.0)[:, None, None] * np.ones((1, STEPS, 7))
    state = goal * np.arange(STEPS)[:, None] / STEPS
    noise = np.random.default_rng(0).normal(size=(2, EPISODES, STEPS, 7)) * 0.05
    return Episodes(
        image={"side": np.zeros((EPISODES, STEPS, 32, 32, 3), np.uint8)},
        state=(state + noise[0]).astype(np.float32),
        action=(goal + noise[1]).astype(np.float32),
        length=np.full(EPISODES, STEPS, np.int32),
        instruction=np.zeros(EPISODES, np.int32),
        instructions=("press the button",),
        task="press",
        robot="piper",
        control_dt=0.1,
        physics_dt=0.0,
        attempted=EPISODES,
        success=right.astype(np.int32),
    )


def prepare(folder, learn, backbone="pi0", **more):
    """Prepare a run on `folder`/data with the dummy backbone."""
    source = DataConfig(str(folder / "data"), validation=("0",))
    options = {"data": source, "learn": learn, "peft": LoRA(rank=8), "targets": (".*",)}
    optim = {"steps": 150, "batch_size": 32, "learning_rate": 1e-2, "warmup_steps": 10}
    options["optim"] = dataclasses.replace(CONFIG.optim, **optim, state_noise=0.0)
    options["evaluation"] = dataclasses.replace(CONFIG.evaluation, execute_steps=1)
    config = dataclasses.replace(CONFIG, **{**options, "log_every": 150, **more})
    model = random_backbone(BACKBONES[backbone].dummy())
    remat = "none", preflight.Memory(*6 * [0.0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preflight, "available_bytes", lambda: 2**40)
        patch.setattr(preflight, "choose_remat", lambda *_: remat)
        patch.setattr(setup, "base_model", lambda *_, **__: (model, ""))
        run_folder = folder / f"{learn}-{backbone}"
        run_folder.mkdir(exist_ok=True)
        console = Console(file=io.StringIO(), width=200)
        run = setup.prepare(config, run_folder, console, time.perf_counter())
    run.devices = jax.devices()[:1]
    return run


def right(run, row=0):
    """Return how often the policy goes right at the fork, told what `row` of its prompts says."""
    observation = {"image": {"side": np.zeros((64, 32, 32, 3), np.uint8)}}
    observation["state"] = np.zeros((64, 7), np.float32)
    policy = run.policy.with_sampler()
    actions = policy.sample(jax.random.key(0), observation, np.full(64, row, np.int32))
    return float((np.asarray(actions)[:, 0, 0] > 0).mean())


@pytest.fixture
def folder(tmp_path):
    rlds.write(fork(), tmp_path / "data")
    return tmp_path


@pytest.mark.parametrize("backbone", mostly_slow(BACKBONES, ["pi0"]))
def test_what_failed_is_not_learned(folder, backbone):
    """Imitation is torn between both; asked for good actions, or bad ones, recap does them."""
    found = {}
    for learn in ("imitation", "filtered", "recap"):
        t=time.time()
        run = prepare(folder, learn, backbone)
        train(run)
        found[learn] = right(run)
        print(learn, found[learn], time.time()-t, run.console.file.getvalue()[-300:])
    print(right(run,1), right(run,2))
    assert 0.2 < found["imitation"] < 0.8
    assert found["filtered"] > 0.95
    assert found["recap"] > 0.9
    assert right(run, 1) < 0.1
    assert 0.2 < right(run, 2) < 0.8
