"""What a training step will need of the device's memory, from shapes alone, before compilation.

The base, the adapters, their gradients and the optimizer's state are counted exactly; activations
are what JAX stores for the backward pass, which XLA can only lessen. What a layer needs while it
runs comes on top: `HEADROOM`.
"""

import dataclasses
import functools
import math
import os
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.config import Config
from lorasp_jax.data.batches import Batch
from lorasp_jax.models import presets
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.config import BackboneConfig, Remat
from lorasp_jax.models.observation import abstract_observation
from lorasp_jax.training.cost import flops
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.optim import auxiliary_weights, make_optimizer
from lorasp_jax.training.step import Metrics, init_state, loss_fn

HEADROOM = 1.1
"""Factor on the sum for what is not counted: temporary arrays, the compiled program, fragments."""
REMATS: tuple[Remat, ...] = ("none", "products", "full")
GIB, MIB = 2**30, 2**20


def unit_of(size: float) -> tuple[int, str]:
    """In what to tell so many bytes, and its name: GiB, or MiB where that would be mostly zeros."""
    return (GIB, "GiB") if size >= GIB else (MIB, "MiB")


@dataclasses.dataclass(frozen=True)
class Memory:
    """Bytes on one device."""

    base: float
    adapters: float
    gradients: float
    optimizer: float
    activations: float

    @property
    def peak(self) -> float:
        """What to expect at the worst moment."""
        return HEADROOM * sum(dataclasses.astuple(self))

    def __str__(self) -> str:
        """All parts, in the unit that suits the sum."""
        unit, name = unit_of(self.peak)
        parts = [f"{part} {value / unit:.2f}" for part, value in dataclasses.asdict(self).items()]
        return f"{', '.join(parts)}, peak {self.peak / unit:.2f} {name}"


class AbstractStep(NamedTuple):
    """What a training step differentiates, for a look at it without arrays.

    Attributes:
        loss: function of the other three that gives the loss and its metrics.
        adapters: shapes of what trains.
        frozen: of the base.
        batch: of what the step sees.
    """

    loss: Callable[[Any, Any, Batch], tuple[jax.Array, Metrics]]
    adapters: Any
    frozen: Any
    batch: Batch


def choose_remat(config: Config, wanted: BackboneConfig, available: float) -> tuple[Remat, Memory]:
    """The least rematerialisation that fits into `available` bytes a device, and what it needs.

    Raises:
        ValueError: nothing that the config allows fits; says what would help.
    """
    asked = config.model.remat
    choices = REMATS if asked == "auto" else (asked,)
    for remat in choices:
        memory = expected(config, dataclasses.replace(wanted, remat=remat))
        if memory.peak <= available:
            return remat, memory
    raise ValueError(_refusal(config, memory, choices[-1], available))


def _refusal(config: Config, memory: Memory, remat: Remat, available: float) -> str:
    """Why a run cannot begin, and what would help."""
    batch, fixed = config.optim.batch_size, memory.peak - HEADROOM * memory.activations
    fitting = math.floor(batch * (available - fixed) / (memory.peak - fixed))
    fitting -= fitting % (jax.device_count() * config.optim.accumulate)
    hints = [f"--optim.batch-size {fitting}"] if 0 < fitting < batch else []
    parts = 2 * config.optim.accumulate
    if batch % (jax.device_count() * parts) == 0:
        hints += [f"--optim.accumulate {parts}"]
    hints += ["--model.remat full"] if remat != "full" else []
    hints += ["--model.param-dtype bfloat16"] if config.model.param_dtype != "bfloat16" else []
    hints += [f"--fsdp {2 * config.fsdp} on as many devices"]
    return (
        f"this run needs about {memory.peak / GIB:.1f} GiB of memory and there are "
        f"{available / GIB:.1f} ({memory}); try {', '.join(hints)}"
    )


def expected(config: Config, wanted: BackboneConfig) -> Memory:
    """Memory of one training step; large arrays are split over `config.fsdp` devices.

    Args:
        config: the run.
        wanted: the backbone's config.
    """
    own = max(1, config.optim.batch_size // jax.device_count())
    step = abstract_step(config, wanted, max(1, own // config.optim.accumulate))
    optimizer = make_optimizer(config.optim, {config.peft.as_saved})

    start = functools.partial(init_state, optimizer=optimizer, ema=config.optim.ema > 0)

    def stored(adapters: Any, frozen: Any, batch: Batch) -> Any:
        return jax.vjp(lambda a: step.loss(a, frozen, batch), adapters, has_aux=True)[1]

    jaxpr = jax.make_jaxpr(stored)(step.adapters, step.frozen, step.batch).jaxpr
    kept = {id(v): v.aval for v in jaxpr.outvars}
    for variable in (*jaxpr.invars, *jaxpr.constvars):  # there anyway
        kept.pop(id(variable), None)
    held = functools.partial(meshes.bytes_on_device, fsdp=config.fsdp)
    adapters = held(step.adapters)
    return Memory(
        base=held(step.frozen),
        adapters=adapters,
        gradients=adapters * (1 if config.optim.accumulate == 1 else 2),
        optimizer=held(jax.eval_shape(start, step.adapters)) - adapters,
        activations=_bytes(list(kept.values())) + _bytes(abstract_batch(wanted, own)),
    )


def adapted(config: Config, wanted: BackboneConfig, key: jax.Array) -> Backbone:
    """A random model with the run's adapters; works under `nnx.eval_shape`."""
    base, adapters = (nnx.Rngs(k) for k in jax.random.split(key))
    rules = presets.rules(config.targets, config.peft.as_saved)
    return adaptation.adapt(wanted.create(base), rules, rngs=adapters)


def abstract_model(config: Config, wanted: BackboneConfig) -> Backbone:
    """The shapes of `adapted`."""
    return nnx.eval_shape(lambda: adapted(config, wanted, jax.random.key(0)))


def abstract_step(config: Config, wanted: BackboneConfig, batch_size: int) -> AbstractStep:
    """The loss of a run, whose auxiliary losses weigh nothing, and shapes of what it takes."""
    graphdef, adapters, frozen = adaptation.split(abstract_model(config, wanted))
    weights: Any = dict.fromkeys(auxiliary_weights(config.auxiliary, 1), 0.0)

    def loss(adapters: Any, frozen: Any, batch: Batch) -> tuple[jax.Array, Metrics]:
        return loss_fn(adapters, frozen, graphdef, batch, jax.random.key(0), weights)

    return AbstractStep(loss, adapters, frozen, abstract_batch(wanted, batch_size))


def operations(config: Config, wanted: BackboneConfig) -> float:
    """Floating-point operations of one training step over all devices, nothing counted twice."""
    step = abstract_step(config, dataclasses.replace(wanted, remat="none"), config.optim.batch_size)
    gradient = jax.grad(step.loss, has_aux=True)
    return flops.count(gradient, step.adapters, step.frozen, step.batch)


def abstract_batch(config: BackboneConfig, size: int) -> Batch:
    """Shapes of a batch of `size` windows."""
    shape = (size, config.chunk, config.action_dim)
    actions: Any
    mask: Any
    actions, mask = (jax.ShapeDtypeStruct(shape, kind) for kind in ("float32", "bool"))
    return Batch(abstract_observation(config, size), actions, mask)


def available_bytes() -> float:
    """Memory of the first device that JAX may use; of the machine on a CPU, shared by devices."""
    stats = jax.local_devices()[0].memory_stats()
    if stats and "bytes_limit" in stats:
        return float(stats["bytes_limit"])
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return machine / jax.local_device_count()


def _bytes(tree: Any) -> float:
    leaves = [leaf for leaf in jax.tree.leaves(tree) if hasattr(leaf, "dtype")]
    return float(sum(leaf.size * leaf.dtype.itemsize for leaf in leaves))
