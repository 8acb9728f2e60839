"""What is compiled while demonstrations are collected is what the run needs afterwards."""

import dataclasses
import io
import threading
from types import SimpleNamespace

import jax
import pytest
from rich.console import Console

from lorasp_jax.config import EvaluationConfig
from lorasp_jax.evaluation import callback
from lorasp_jax.evaluation.programs import make_rollout
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import LoRA
from lorasp_jax.training import early, loop, program, setup
from lorasp_jax.training.distributed import mesh as meshes
from tests.evaluation.test_programs import POLICY, WORLD, Room, compilations
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, random_episodes


@dataclasses.dataclass(frozen=True, eq=False)
class Hall(Room):
    """A room as a run's environment."""

    cameras: tuple[str, ...] = ("side", "wrist")
    robot: SimpleNamespace = dataclasses.field(
        default_factory=lambda: SimpleNamespace(num_joints=6)
    )


ROOM = Hall(random_episodes("", 0).instructions, max_steps=6)


@pytest.fixture
def prepare(monkeypatch, tmp_path):
    """(meanwhile) -> run, on one device, without simulation."""
    mesh = meshes.make_mesh(1, jax.devices()[:1])
    monkeypatch.setattr(meshes, "make_mesh", lambda *_: mesh)
    monkeypatch.setattr(setup.envs, "make", lambda *_, **__: ROOM)
    settings = EvaluationConfig(episodes=16, num_envs=16, execute_steps=1)
    config = dataclasses.replace(
        CONFIG, peft=LoRA(rank=4), targets=("action_out_proj",), evaluation=settings
    )

    base = random_backbone(Pi0Config.dummy()), ""
    monkeypatch.setattr(setup, "base_model", lambda *_, **__: base)

    def collect(config, *_):
        return {task: random_episodes(task, 0) for task in config.tasks}

    def prepare(*meanwhile, collect=collect):
        console = Console(file=io.StringIO())
        return setup.prepare(config, tmp_path, console, 0.0, collect=collect, meanwhile=meanwhile)

    return prepare


def test_the_run_compiles_and_traces_nothing_else(prepare, monkeypatch):
    texts, jit_steps, calls, train_step = [], program.jit_steps, [], program.train_step

    def counted(*arguments, **options):
        calls.append(None)
        return train_step(*arguments, **options)

    def recorded(*arguments):
        def lower(*shapes):
            lowered = jitted.lower(*shapes)
            texts.append(lowered.as_text())
            return lowered

        jitted = jit_steps(*arguments)
        return SimpleNamespace(lower=lower)

    def compile_rollout(run, task):
        del run, task
        return ROOM, make_rollout(ROOM, execute_steps=1, denoise_steps=2)

    monkeypatch.setattr(program, "train_step", counted)
    monkeypatch.setattr(program, "jit_steps", recorded)
    monkeypatch.setattr(loop, "jit_steps", recorded)
    monkeypatch.setattr(callback, "compiled_rollout", compile_rollout)
    evaluation = callback.Evaluation(media=False)
    with compilations() as counts:
        run = prepare(early.compile_training, evaluation.compile_early)
    assert counts == POLICY | dict.fromkeys(WORLD, 1)
    traced = len(calls)
    with compilations() as counts:
        loop.train(run, [evaluation])
    assert counts == {}
    early_text, *used = texts
    assert used == [early_text]  # so that JAX finds the program in its cache on disk
    assert len(calls) == traced > 0


def test_errors_reach_the_caller(prepare):
    """Those of `meanwhile` after the demonstrations; those of the demonstrations at once."""

    def fail(run, built):
        raise ValueError("cannot compile")

    with pytest.raises(ValueError, match="cannot compile"):
        prepare(fail)
    waiting = threading.Event()

    def cannot_collect(*_):
        raise ValueError("cannot collect")

    with pytest.raises(ValueError, match="cannot collect"):
        prepare(lambda *_: waiting.wait(60), collect=cannot_collect)
    waiting.set()
