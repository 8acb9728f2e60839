"""Runs that need no simulation: random episodes and a tiny backbone."""

import dataclasses
import io
import os
import signal
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from PIL import Image
from rich.console import Console

from envs.datasets.episodes import Episodes
from envs.rendering.video import write_video
from lorasp_jax import models
from lorasp_jax.adapters import adaptation
from lorasp_jax.config import Config, ModelConfig, OptimConfig
from lorasp_jax.dense import Dense
from lorasp_jax.models import flow_matching
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import LoRA, LoRASP, Method
from lorasp_jax.policies import tokenizer
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.training import export
from lorasp_jax.training.base import TRAINING
from lorasp_jax.training.export import BASE
from lorasp_jax.training.rules import rules
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import MetricsLog, read_metrics, to_json, write_json
from lorasp_jax.training.setup import processor
from tests.models.random_models import random_backbone, with_noise

TIMED = ("speed/", "memory/")

CONFIG = Config(
    name="test",
    scale="smoke",
    peft=LoRASP(rank=8, hidden_width=8),
    tasks=("press", "pick_place"),
    model=ModelConfig(size="dummy", checkpoint=""),
    targets=("patch_embed", "q_proj", "down_proj", "action_out_proj"),
    image_size=32,
    optim=OptimConfig(steps=4, batch_size=8, warmup_steps=1),
    log_every=2,
    checkpoint_every=2,
)

RESULTS = {
    "scale": "cpu",
    "seconds": {"collect": 1.0, "train": 2.0, "evaluate": 3.0, "total": 7.0},
    "tasks": {
        "press": {
            "before": {"success": 0.03125, "episodes": 64, "ci95": [0.009, 0.107]},
            "after": {"success": 0.75, "episodes": 64, "ci95": [0.632, 0.84]},
        }
    },
    "active_rank": {"vision": 4.25, "language": 3.0, "action": 2.0, "mean": 3.1},
    "layer_active_rank": {"vision": {"fc1": [4.0, 4.5]}, "action": {"q_proj": [2.0]}},
    "active_rank_histogram": {},
    "trainable_parameters": 10,
    "total_parameters": 1000,
}
"""Contents of results.json."""


def write_description(folder: Path, robot: str = CONFIG.robot) -> None:
    """Write what a run that trained its base says of its policy's robot, without weights."""
    (folder / BASE).mkdir()
    write_json(folder / BASE / TRAINING, {"robot": robot})


PROGRAMS: dict[Any, Any] = {}
"""For `Run.programs`: runs with equal inputs then trace and lower their program only once."""


class Miniature(nnx.Module):
    """Two-layer stand-in for a backbone, so that a training process starts immediately."""

    def __init__(self):
        self.config = Pi0Config.dummy()
        rngs, size = nnx.Rngs(0), self.config.action_dim
        self.inp, self.out = Dense(size, 64, rngs=rngs), Dense(64, size, rngs=rngs)

    def loss(self, key, observation, actions, *, noise=None, flow_time=None, **_):
        if noise is None:
            noise, flow_time = flow_matching.draw(key, actions)
        noisy, velocity = flow_matching.interpolate(noise, actions, flow_time)
        seen = sum(image.mean((1, 2, 3)) for image in observation.images.values())
        inputs = noisy + (observation.state + seen[:, None])[:, None]
        hidden, first = self.inp(inputs, return_aux=True)
        predicted, second = self.out(jnp.tanh(hidden), return_aux=True)
        return (predicted - velocity) ** 2, {"action": {"inp": first, "out": second}}


class Terminate(Callback):
    """Send SIGTERM to this process after step 2, as a scheduler would."""

    def __init__(self):
        self.started = 0

    def on_start(self, run):
        self.started += 1

    def on_log(self, run, step, metrics):
        if step == 2:
            os.kill(os.getpid(), signal.SIGTERM)


def random_episodes(task: str, seed: int) -> Episodes:
    rng = np.random.default_rng(seed)
    length = np.array([5, 9, 7], np.int32)
    return Episodes(
        image={
            name: rng.integers(0, 255, (3, 9, 32, 32, 3), np.uint8) for name in ("side", "wrist")
        },
        state=rng.normal(size=(3, 9, 7)).astype(np.float32),
        action=rng.normal(size=(3, 9, 7)).astype(np.float32),
        length=length,
        instruction=np.array([0, 1, 0], np.int32),
        instructions=("press the button", "push the button"),
        task=task,
        robot="piper",
        control_dt=0.1,
        physics_dt=0.005,
        attempted=3,
    )


def make_run(
    folder: Path, config: Config = CONFIG, model: Any = None, devices: int | None = 1
) -> Run:
    """Make a run; the default, the dummy backbone on one device, compiles four times faster."""
    folder.mkdir(exist_ok=True)
    model = model or random_backbone(Pi0Config.dummy())
    model = adaptation.adapt(model, rules(config), rngs=nnx.Rngs(1))
    run = Run(config, folder, Console(file=io.StringIO()), "hash of the base")
    run.devices = jax.devices()[:devices]
    run.episodes = {task: random_episodes(task, i) for i, task in enumerate(config.tasks)}
    groups = list(run.episodes.values())
    phrases = [phrase for group in groups for phrase in group.instructions]
    prompts = PromptTable.of(tokenizer.Offline(), phrases, model.config, num_joints=6)
    run.policy = Policy(model, processor(groups, model.config, prompts))
    return run


def repeatable(folder: Path) -> list[dict[str, float]]:
    """Return the logged metrics without those that depend on timing."""
    rows = read_metrics(folder)
    return [{k: v for k, v in row.items() if not k.startswith(TIMED)} for row in rows]


def leaves(tree) -> dict[str, np.ndarray]:
    pairs = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in pairs}


def finish(folder: Path) -> Path:
    """Write the files of a finished run with two logged steps, without weights."""
    write_json(folder / "config.json", {**to_json(CONFIG), "name": "<b>run</b>"})
    write_json(folder / "results.json", RESULTS)
    log = MetricsLog(folder)
    for step in (2, 4):
        log.write(step, {"task": 1 / step, "spectral": 0.1, "active_rank/vision": 4.0})
    log.close()
    frames = np.random.default_rng(0).integers(0, 255, (4, 32, 64, 3), np.uint8)
    Image.fromarray(frames[0]).save(folder / "cameras_press.png")
    write_video(folder / "rollout_press.mp4", frames, fps=10)
    return folder


def finish_with_weights(folder: Path, peft: Method = LoRA(rank=4)) -> Path:  # noqa: B008
    """Write a finished run of one task, by default with LoRA, whose base is saved beside it."""
    base = folder.parent / "base"
    model = ModelConfig(size="dummy", checkpoint=str(base))
    config = dataclasses.replace(CONFIG, peft=peft, model=model, tasks=("press",))
    run = make_run(folder, config)
    models.save(base, random_backbone(Pi0Config.dummy()))
    graphdef, adapters, frozen = adaptation.split(run.policy.model)
    some = with_noise(adapters, 0.03)
    run.policy = dataclasses.replace(run.policy, model=nnx.merge(graphdef, some, frozen))
    write_json(folder / "config.json", to_json(config))
    write_json(folder / "results.json", RESULTS)
    export.write(run)
    return folder
