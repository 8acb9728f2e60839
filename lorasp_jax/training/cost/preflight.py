"""Estimate the device memory of a training step from shapes alone, before compilation.

Base, adapters, gradients and optimizer state are counted exactly. Activations are the batch and
the residuals that JAX saves for the backward pass; XLA may save fewer, most of all without
rematerialization. With it, what one layer recomputes comes on top. `HEADROOM` covers the rest. A
dry run prints what XLA plans beside it.
"""

import dataclasses
import functools
import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.config import VALIDATION_WINDOWS, Config
from lorasp_jax.data.batches import Batch, nbytes
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.config import BackboneConfig, Remat
from lorasp_jax.models.observation import abstract_observation
from lorasp_jax.models.sampling import Sampler, suffix_model
from lorasp_jax.training import rules
from lorasp_jax.training.base import quantized
from lorasp_jax.training.cost import flops
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.optim import auxiliary_weights, flow_times, make_optimizer
from lorasp_jax.training.step import Metrics, init_state, loss_fn

HEADROOM = 1.05
"""Factor on the total to cover temporaries, the executable and fragmentation."""
REMATS: tuple[Remat, ...] = ("none", "products", "narrow", "full")
GIB, MIB = 2**30, 2**20


def byte_unit(size: float) -> tuple[int, str]:
    """Return the unit (bytes, name) for printing `size` bytes: GiB, or MiB below 1 GiB."""
    return (GIB, "GiB") if size >= GIB else (MIB, "MiB")


@dataclasses.dataclass(frozen=True)
class Memory:
    """Memory of one device [bytes]."""

    base: float
    adapters: float
    gradients: float
    optimizer: float
    activations: float
    recomputation: float

    @property
    def peak(self) -> float:
        """Estimated peak memory."""
        return HEADROOM * sum(dataclasses.astuple(self))

    def __str__(self) -> str:
        unit, name = byte_unit(self.peak)
        parts = [f"{part} {value / unit:.2f}" for part, value in dataclasses.asdict(self).items()]
        return f"{', '.join(parts)}, peak {self.peak / unit:.2f} {name}"


def choose_remat(
    config: Config, backbone: BackboneConfig, available: float
) -> tuple[Remat, Memory]:
    """Return the least rematerialization that fits in `available` device bytes, and its estimate.

    Raises:
        ValueError: none fits.
    """
    remat = config.model.remat
    memory: dict[Remat, Memory] = {}
    for choice in REMATS if remat == "auto" else (remat,):
        memory[choice] = estimate_memory(config, dataclasses.replace(backbone, remat=choice))
        if memory[choice].peak <= available:
            return choice, memory[choice]
    least = min(memory, key=lambda choice: memory[choice].peak)
    raise ValueError(
        f"this run needs about {memory[least].peak / GIB:.1f} GiB per device, but only "
        f"{available / GIB:.1f} GiB are available ({memory[least]}): lower --optim.batch-size, or "
        "see what saves memory in docs/launch.md"
    )


def estimate_memory(config: Config, backbone: BackboneConfig) -> Memory:
    """Estimate the memory of one training step, sharded over `config.fsdp` devices."""
    local_batch = max(1, config.optim.batch_size // jax.device_count())
    micro_batch = max(1, local_batch // config.optim.accumulate)
    base, adapters, optimizer = _held_bytes(
        _of_one_window(config), dataclasses.replace(backbone, remat="none")
    )
    saved = functools.partial(_saved_bytes, config, size=micro_batch)
    batch = nbytes(abstract_batch(backbone, local_batch))
    accumulates = config.optim.accumulate > 1  # which sorts a copy of the batch into micro-batches
    return Memory(
        base=base,
        adapters=adapters,
        # Over micro-batches, XLA keeps a sum and the adapters in the compute dtype.
        gradients=adapters * (1 + accumulates * (1 + _cast_share(backbone))),
        optimizer=optimizer,
        activations=saved(backbone) + batch * (1 + accumulates),
        recomputation=0 if backbone.remat == "none" else _recomputed_bytes(saved, backbone),
    )


def _cast_share(backbone: BackboneConfig) -> float:
    """Return the size of the adapters, which are f32, in the compute dtype, relative to theirs."""
    size = jnp.dtype(backbone.dtype).itemsize
    return size / 4 if size < 4 else 0


def sampling_peak(config: Config, backbone: BackboneConfig) -> float:
    """Estimate the peak memory of evaluating the policy during training.

    In simulation, a `Sampler` has weights of its own. On recordings, a quantized policy copies only
    those of the flow steps, see `held_out`.
    """
    return _sampling_peak(_of_one_window(config), dataclasses.replace(backbone, remat="none"))


@functools.cache
def _sampling_peak(config: Config, backbone: BackboneConfig) -> float:
    graphdef, state = nnx.split(abstract_model(config, backbone))

    def copies(state: Any) -> Any:
        model = nnx.merge(graphdef, state)
        if config.model.base_dtype and config.data.source:
            return nnx.state(suffix_model(model))
        return Sampler.from_model(model).weights

    copied = _output_bytes(jax.make_jaxpr(copies)(state).jaxpr)
    windows = VALIDATION_WINDOWS if config.data.source else config.evaluation.worlds
    layer = _recomputed_bytes(functools.partial(_saved_bytes, config, size=windows), backbone) / 2
    return HEADROOM * (sum(_held_bytes(config, backbone)) + copied + layer)


def _of_one_window(config: Config) -> Config:
    """Return the config of a step of one window, so that results are cached for all batches."""
    optim = dataclasses.replace(config.optim, batch_size=1, accumulate=1)
    model = dataclasses.replace(config.model, remat="auto")  # that of the backbone counts
    return dataclasses.replace(config, optim=optim, model=model)


@functools.cache
def _held_bytes(config: Config, backbone: BackboneConfig) -> tuple[float, float, float]:
    """Return the bytes of base, adapters and optimizer state."""
    _, shapes, frozen = adaptation.split(abstract_model(config, backbone))
    optimizer = make_optimizer(config.optim, rules.methods(config))
    init = functools.partial(init_state, optimizer=optimizer, ema=config.optim.ema > 0)
    local_bytes = functools.partial(meshes.bytes_on_device, fsdp=config.fsdp)
    adapters = local_bytes(shapes)
    return local_bytes(frozen), adapters, local_bytes(jax.eval_shape(init, shapes)) - adapters


def _recomputed_bytes(saved: Callable[[BackboneConfig], float], backbone: BackboneConfig) -> float:
    """Return the bytes of the matrix products of one layer and of their gradients."""
    products, full = (
        saved(dataclasses.replace(backbone, remat=remat)) for remat in ("products", "full")
    )
    return 2 * (products - full) / min(backbone.vision.depth, backbone.language.depth)


def _saved_bytes(config: Config, backbone: BackboneConfig, *, size: int) -> float:
    """Return the bytes of the residuals that a forward pass of `size` windows saves.

    It is traced for one window, and for two if it also saves slices of stacked weights, as it does
    without rematerialization. Residuals do not depend on how the base is stored.
    """
    model = dataclasses.replace(config.model, base_dtype="", param_dtype="float32")
    stored = dataclasses.replace(_of_one_window(config), model=model)
    backbone = dataclasses.replace(backbone, param_dtype="bfloat16")
    traced = functools.partial(_traced_bytes, stored, backbone)
    each = traced(2) - traced(1) if backbone.remat == "none" else traced(1)
    return traced(1) + (size - 1) * each


@functools.cache
def _traced_bytes(config: Config, backbone: BackboneConfig, size: int) -> int:
    """Return the bytes of what a forward pass keeps, except its inputs, such as parameters."""
    loss, shapes = abstract_step(config, backbone, size)

    def forward(adapters: Any, frozen: Any, batch: Batch) -> Any:
        return jax.vjp(lambda a: loss(a, frozen, batch), adapters, has_aux=True)[1]

    return _output_bytes(jax.make_jaxpr(forward)(*shapes).jaxpr)


def _output_bytes(jaxpr: Any) -> int:
    """Return the bytes of a function's results, except inputs that it returns as they are."""
    inputs = {id(variable) for variable in (*jaxpr.invars, *jaxpr.constvars)}
    return nbytes([*{id(v): v.aval for v in jaxpr.outvars if id(v) not in inputs}.values()])


def adapted_model(config: Config, backbone: BackboneConfig, key: jax.Array) -> Backbone:
    """Create a random model with the run's adapters; works under `nnx.eval_shape`."""
    base, adapters = (nnx.Rngs(k) for k in jax.random.split(key))
    pairs = rules.rules(config, as_saved=True)
    adapted = adaptation.adapt(backbone.create(base), pairs, rngs=adapters)
    return quantized(adapted, config.model.base_dtype)


def abstract_model(config: Config, backbone: BackboneConfig) -> Backbone:
    """Return `adapted_model` with shapes in place of arrays."""
    return nnx.eval_shape(lambda: adapted_model(config, backbone, jax.random.key(0)))


def abstract_step(
    config: Config, backbone: BackboneConfig, batch_size: int
) -> tuple[Callable[[Any, Any, Batch], tuple[jax.Array, Metrics]], tuple[Any, Any, Batch]]:
    """Return the run's loss, with auxiliary weights of zero, and the shapes of its inputs.

    These are adapters, frozen parameters and the batch.
    """
    graphdef, adapters, frozen = adaptation.split(abstract_model(config, backbone))
    weights: Any = dict.fromkeys(auxiliary_weights(config.auxiliary, 1), 0.0)

    def loss(adapters: Any, frozen: Any, batch: Batch) -> tuple[jax.Array, Metrics]:
        key, times = jax.random.key(0), flow_times(config.optim)
        return loss_fn(adapters, frozen, graphdef, batch, key, weights, times=times)

    return loss, (adapters, frozen, abstract_batch(backbone, batch_size))


def step_flops(config: Config, backbone: BackboneConfig) -> float:
    """Count the FLOPs of one training step over all devices, without recomputation."""
    backbone = dataclasses.replace(backbone, remat="none")
    loss, shapes = abstract_step(config, backbone, config.optim.batch_size)
    return flops.count(jax.grad(loss, has_aux=True), *shapes)


def abstract_batch(config: BackboneConfig, size: int) -> Batch:
    """Return the shapes of a batch of `size` windows."""
    shape = (size, config.chunk, config.action_dim)
    actions: Any
    mask: Any
    actions, mask = (jax.ShapeDtypeStruct(shape, dtype) for dtype in ("float32", "bool"))
    return Batch(abstract_observation(config, size), actions, mask)


def available_bytes() -> float:
    """Return JAX's memory limit on the first device, or host memory per device if none is set."""
    stats = jax.local_devices()[0].memory_stats()
    if stats and "bytes_limit" in stats:
        return float(stats["bytes_limit"])
    host_bytes = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return host_bytes / jax.local_device_count()
