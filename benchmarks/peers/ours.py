"""This project on the workloads that it shares with the other programs."""

import dataclasses
import functools
import itertools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

import lorasp_jax
from benchmarks import backbones
from benchmarks import peft as layers
from benchmarks.peers import stacks, worker, workloads
from benchmarks.peers.worker import Job, Row
from lorasp_jax import peft
from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.data.batches import Batch
from lorasp_jax.extras.serving.exported import sampling_options
from lorasp_jax.models import presets
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.config import BackboneConfig, ExpertConfig, VisionConfig
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.sampling import Sampler
from lorasp_jax.models.smolvla import SmolVLAConfig

PACKAGES = ("lorasp_jax", "jax", "flax", "optax")
METHODS = {"LoRA-SP": peft.LoRASP, "LoRA": peft.LoRA, "DoRA": peft.DoRA}
OPENPI = "openpi's LoRA"
"""Trains what openpi trains: ranks 16 and 32 in the experts, all of the vision tower, and the
projections."""
TINY: dict[str, dict[str, Any]] = {
    "pi0": {
        "vision": VisionConfig(width=32, depth=1, mlp=128, heads=2, patch=16),
        "language": ExpertConfig(64, 4, 128, heads=8, kv_heads=1, head_dim=16),
        "action": ExpertConfig(64, 4, 128, heads=8, kv_heads=1, head_dim=16),
    },
    "smolvla": {
        "vision": VisionConfig(width=32, depth=2, mlp=48, heads=2, patch=8, shuffle=2),
        "language": ExpertConfig(64, 4, 128, heads=4, kv_heads=2, head_dim=16),
        "action": ExpertConfig(48, 4, 256, heads=4, kv_heads=2, head_dim=16),
    },
}
"""The towers to which the other programs' models are reduced."""


def workload(job: Job) -> tuple[str, workloads.Policy]:
    """Return the backbone of a table and its shapes."""
    name = job.table.partition("-")[0]
    return name, (workloads.PI0 if name == "pi0" else workloads.SMOLVLA)[job.size]


def model_config(job: Job, remat: Any = "none") -> BackboneConfig:
    """Return the backbone's config in bf16."""
    name, shape = workload(job)
    published: BackboneConfig = {"pi0": Pi0Config, "smolvla": SmolVLAConfig}[name].base()
    if job.size == "tiny":
        published = dataclasses.replace(published, **TINY[name], vocabulary=320, unroll=False)
    return dataclasses.replace(
        published,
        cameras=published.cameras[: shape.cameras],
        image_size=shape.image,
        max_tokens=shape.tokens,
        chunk=shape.chunk,
        action_dim=shape.dim,
        param_dtype="bfloat16",
        remat=remat,
    )


def rules(job: Job) -> tuple[paths.Rules, peft.Method]:
    """Return the variant's rules for `adapt`, and the method that its optimizer is made for."""
    if job.variant == OPENPI:
        full = peft.FullFineTuning()
        experts: paths.Rules = [
            (rf"^{tower}/blocks/(.*/)?[a-z]+_proj$", peft.LoRA(rank=rank))
            for tower, rank in (("language", 16), ("action", 32))
        ]
        whole = presets.rules(("vision", presets.PRESETS["expert-only"][1]), full)
        return [*experts, *whole], full
    if job.variant == "expert only":
        full = peft.FullFineTuning()
        return presets.rules("expert-only", full), full
    method = METHODS[job.variant](rank=workload(job)[1].rank)
    return presets.rules("all-linear", method), method


def batch(job: Job, size: int) -> Batch:
    """Return the common batch."""
    drawn = workloads.policy_batch(workload(job)[1], size)
    cameras = model_config(job).cameras
    observation = Observation(
        images={n: jnp.asarray(x) for n, x in zip(cameras, drawn["images"], strict=True)},
        image_masks={name: jnp.ones(size, bool) for name in cameras},
        tokens=jnp.asarray(drawn["tokens"]),
        token_mask=jnp.ones(drawn["tokens"].shape, bool),
        state=jnp.asarray(drawn["state"]),
    )
    actions = jnp.asarray(drawn["actions"])
    return Batch(observation, actions, jnp.ones(actions.shape, bool))


def train(job: Job) -> Iterator[Row]:
    """Time training steps as `lorasp_jax.training` takes them, without data loading and logging.

    Products with weights are kept for the backward pass (`--model.remat products`) where the
    memory of one GPU requires it, otherwise everything is.
    """
    remat = "products" if job.table.startswith("pi0") else "none"
    config, (chosen, method), size = model_config(job, remat), rules(job), workload(job)[1].batch

    def model(key: jax.Array) -> Backbone:
        base, adapters = (nnx.Rngs(k) for k in jax.random.split(key))
        return adaptation.adapt(config.create(base), chosen, rngs=adapters)

    run = backbones.run_config(method, (), size)
    shapes = nnx.eval_shape(lambda: model(jax.random.key(0)))
    step = backbones.Step(config, run, model=shapes)  # compiles, while the memory is free
    trained, frozen = backbones.drawn(model)[1:]
    step.load(trained, frozen, batch(job, size))
    count = sum(leaf.size for leaf in jax.tree.leaves(trained))
    del trained, frozen
    row = worker.timed(f"batch {size}", step, jax.block_until_ready, job)
    yield row | {"samples": size, "trainable": count, "gib": worker.jax_peak_gib()}


def sample(job: Job) -> Iterator[Row]:
    """Time sampling with a prepared sampler, from images to actions."""
    config = model_config(job)
    run = None if job.variant == "none" else backbones.run_config(rules(job)[1], ("all-linear",), 1)
    sampler = nnx.merge(*backbones.arrays(config, run)).sampler()

    @functools.partial(jax.jit, static_argnums=2, compiler_options=sampling_options())
    def draw(sampler: Sampler, observation: Observation, steps: int) -> jax.Array:
        return sampler.sample_actions(jax.random.key(1), observation, num_steps=steps)

    for size, steps in itertools.product(workload(job)[1].sampled, job.denoise_steps):
        call = functools.partial(draw, sampler, batch(job, size).observation, steps)
        item = worker.sampled(size, steps)
        yield worker.timed(item, call, jax.block_until_ready, job) | {"samples": size}


def single_layers(job: Job) -> Iterator[Row]:
    """Time adapted layers as in `benchmarks.peft`: forward, and both passes."""
    sizes, kind = workloads.LAYERS[job.size], METHODS[job.variant]
    for shape in sizes.shapes:
        method = kind(rank=sizes.rank)
        x, kernel, gradient = (
            jnp.asarray(array, jnp.bfloat16)
            for array in workloads.layer_arrays(shape, sizes.tokens)
        )
        params, layer = jax.jit(method.init)(jax.random.key(0), kernel)[0], layers.adapted(method)
        forward = jax.jit(lambda params, x, w, layer=layer: layer(params, x, w)[0])
        both = jax.jit(functools.partial(layers.with_gradients, layer))
        name, arrays = "x".join(map(str, shape)), (params, x, kernel)
        calls = {"forward": functools.partial(forward, *arrays)}
        calls["both"] = functools.partial(both, *arrays, gradient)
        for item, call in calls.items():
            yield worker.timed(f"{name} {item}", call, jax.block_until_ready, job)


def stack(job: Job) -> Iterator[Row]:
    """Measure a stack of adapted layers, on an nf4 base if the variant says so."""
    sizes = workloads.STACK[job.size]
    name, _, base = job.variant.partition(" on ")
    adapter = [("layers", METHODS[name](rank=sizes.rank))]
    model: Any = lorasp_jax.adapt(stacks.Stack(sizes.depth, sizes.width), adapter, rngs=nnx.Rngs(0))
    if base:
        model = lorasp_jax.quantize(model, [("layers", "nf4")]).model
    yield from stacks.rows(model, stacks.inputs(sizes), job)


def measure(job: Job) -> Iterator[Row]:
    """Yield the rows of one job."""
    if job.table.startswith("layer"):
        yield from single_layers(job)
    elif job.table.startswith("stack"):
        yield from stack(job)
    else:
        yield from (sample if job.table.endswith("sample") else train)(job)


if __name__ == "__main__":
    worker.main(measure, worker.jax_device, PACKAGES)
