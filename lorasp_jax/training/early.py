"""Compile the training program before there are demonstrations, from shapes alone."""

import dataclasses
import functools
from typing import Any

import jax
import numpy as np
from flax import nnx

from envs.datasets.episodes import Episodes
from lorasp_jax.adapters import adaptation
from lorasp_jax.base import messages
from lorasp_jax.config import Config
from lorasp_jax.data.batches import flatten, nbytes
from lorasp_jax.data.joined import parts_of
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor
from lorasp_jax.training import program, protect, setup
from lorasp_jax.training.batches import DrawnBatches
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.optim import make_optimizer
from lorasp_jax.training.run import Run
from lorasp_jax.training.step import init_state


def compile_training(run: Run, built: setup.RunSetup) -> None:
    """Compile the program that `loop.train` calls first; JAX's cache on disk keeps it.

    A dataset is left alone, because another thread may be reading it.
    """
    if built.source is None:
        compile_steps(run, built, data_shapes(run, built)[1])


def compile_steps(run: Run, built: setup.RunSetup, batches: Any) -> Any:
    """Compile the training program for batches of these shapes, from `data_shapes`."""
    with messages.announce("the training step"):
        lowered = _lower(run, built, batches)
        return lowered.compile()


def blank_policy(run: Run, built: setup.RunSetup) -> Policy:
    """Return the policy that `loop.train` starts with, but for the statistics of its data."""
    mesh = meshes.make_mesh(run.config.fsdp, run.devices)
    graphdef, *arrays = adaptation.split(built.model)
    arrays = [jax.device_put(tree, meshes.shardings(tree, mesh)) for tree in arrays]
    return Policy(nnx.merge(graphdef, *arrays), _blank_processor(run.config, built))


def data_shapes(run: Run, built: setup.RunSetup) -> tuple[int, Any]:
    """Return the bytes of the dataset and the shapes of a call's batches.

    A streamed dataset has 0 bytes on the device. Without a dataset, all demonstrations are assumed
    to have the maximum length; with `data.fresh_every`, there are two generations of them.
    """
    config, source = run.config, built.source
    limits = sum(env.max_steps for env in built.environments)
    count = source.num_steps if source else config.data.episodes * limits
    mesh, size = meshes.make_mesh(config.fsdp, run.devices), config.optim.batch_size
    episode = jax.eval_shape(lambda: flatten([_first_episode(config, built)]))
    if source and parts_of(source)[1:]:
        episode = dataclasses.replace(episode, dataset=episode.end)
    steps = jax.tree.map(lambda x: jax.ShapeDtypeStruct((count, *x.shape[1:]), x.dtype), episode)
    drawn = DrawnBatches(steps, mesh, size, built.base.config.chunk)
    if source is None or nbytes(steps) <= built.free_bytes:
        call_size = drawn.call_size(min(config.log_every, config.optim.steps))
        return nbytes(steps) * (2 if config.data.fresh_every else 1), drawn.shapes(call_size)
    return 0, drawn.shapes(1)


def _blank_processor(config: Config, built: setup.RunSetup) -> Processor:
    """Return the run's processor with the statistics of one episode."""
    episode = _first_episode(config, built)
    cameras = config.data.cameras
    inputs = setup.processor([episode], built.base.config, built.prompts, cameras=cameras)
    parts = parts_of(built.source) if built.source else ()
    return setup.of_datasets(inputs, built.base.config, parts) if parts[1:] else inputs


def _first_episode(config: Config, built: setup.RunSetup) -> Episodes:
    """Return the dataset's first episode, or one of the first task with one step, all zeros."""
    if built.source:
        return built.source.episode(0)
    env, size = built.environments[0], config.image_size
    zeros = np.zeros((1, 1, built.joints + 1), np.float32)
    return Episodes(
        image={name: np.zeros((1, 1, size, size, 3), np.uint8) for name in env.cameras},
        state=zeros,
        action=zeros,
        length=np.ones(1, np.int32),
        instruction=np.zeros(1, np.int32),
        instructions=tuple(built.prompts.instructions),
        task=config.tasks[0],
        robot=config.robot,
        control_dt=config.control_dt,
        physics_dt=0.0,
        attempted=1,
    )


def _lower(run: Run, built: setup.RunSetup, batches: Any) -> Any:
    """Lower the steps that `loop.train` compiles first, from shapes alone."""
    config, model = run.config, built.model
    fixed = protect.fixed(model) if config.protect else None
    optimizer = make_optimizer(config.optim, adaptation.methods(model).values(), fixed)
    mesh = meshes.make_mesh(config.fsdp, run.devices)
    graphdef, adapters, frozen = adaptation.split(model)
    state = jax.eval_shape(
        functools.partial(init_state, optimizer=optimizer, ema=config.optim.ema > 0), adapters
    )
    shardings = meshes.shardings(state, mesh)
    frozen = program.Frozen(frozen, _blank_processor(config, built).shared())
    frozen = jax.tree.map(meshes.with_sharding, frozen, meshes.shardings(frozen, mesh))
    state = jax.tree.map(meshes.with_sharding, state, shardings)
    steps = program.jit_steps(run, graphdef, optimizer, shardings)
    return steps.lower(frozen, batches, state, jax.random.key(0))
