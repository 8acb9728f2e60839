"""Speed of training and sampling for full backbones of published sizes, with random weights.

    python -m benchmarks.backbones --json backbones.json
    python -m benchmarks.backbones --size nano --batch 4 --rank 8 --dtype float32    # on a CPU

The training step is that of `lorasp_jax.training`, with AdamW and the auxiliary losses. Its batch
is already on the device, and its state is donated. The table "largest" uses the largest batch whose
step is expected to fit in `--gib`. Sampling runs ten denoising steps in one program, from images to
action chunk, with the model's `sampler`.

GiB is the memory of the compiled program, including its arguments. MFU is the matmul FLOP/s of loss
and gradients relative to the device's bf16 peak, without recomputation
(`lorasp_jax.training.cost.flops`).
"""

import argparse
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jax.sharding import Mesh
from rich.console import Console

from benchmarks.measuring import best, machine, print_table, write_json
from lorasp_jax import peft
from lorasp_jax.adapters import adaptation
from lorasp_jax.config import Config, ModelConfig, OptimConfig
from lorasp_jax.extras.serving.exported import sampling_options
from lorasp_jax.kernels.quantized_weights import KINDS, Kind
from lorasp_jax.models import backbone
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.config import BackboneConfig, Remat
from lorasp_jax.models.sampling import Sampler
from lorasp_jax.training import compilation
from lorasp_jax.training.cost import flops, preflight
from lorasp_jax.training.cost.preflight import GIB, REMATS, abstract_batch, estimate_memory
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.optim import auxiliary_weights, make_optimizer
from lorasp_jax.training.step import init_state, train_step

CAMERAS = {"pi05": 3, "pi0": 3, "smolvla": 2}


def of_size(name: str, options: argparse.Namespace, cameras: int = 0) -> BackboneConfig:
    """Return the config of a backbone in `CAMERAS`, with parameters in the compute dtype.

    Of its cameras, it has the first ones; 0: as many as `CAMERAS` says.
    """
    family, suffix = ("pi0", "_pi05") if name == "pi05" else (name, "")
    config = getattr(backbone.find(family), options.size + suffix)()
    shown = config.cameras[: cameras or CAMERAS[name]]
    dtypes = {"dtype": options.dtype, "param_dtype": options.dtype}
    return dataclasses.replace(config, cameras=shown, remat="none", **dtypes)


def sized(name: str, options: argparse.Namespace, remat: Remat = "none") -> BackboneConfig:
    """Return the config of `of_size` with the chosen rematerialization and loop over layers."""
    config = of_size(name, options)
    unroll = config.unroll if options.unroll is None else options.unroll == "yes"
    return dataclasses.replace(config, remat=remat, unroll=unroll)


def run_config(
    method: peft.Method, targets: tuple[str, ...], batch: int, base_dtype: Kind | Literal[""] = ""
) -> Config:
    """Return the config of a run."""
    parts = {"model": ModelConfig(base_dtype=base_dtype), "optim": OptimConfig(batch_size=batch)}
    return Config(name="benchmark", scale="", peft=method, targets=targets, **parts)


def arrays(config: BackboneConfig, run: Config | None) -> tuple[Any, Any, Any]:
    """Return the graph, adapters and frozen arrays; without a run, there are no adapters."""

    def model(key: jax.Array) -> Backbone:
        return preflight.adapted_model(run, config, key) if run else config.create(nnx.Rngs(key))

    return drawn(model)


def drawn(model: Callable[[jax.Array], Backbone]) -> tuple[Any, Any, Any]:
    """Return the graph, adapters and frozen arrays of a model drawn from a random key."""
    graphdef = adaptation.split(nnx.eval_shape(lambda: model(jax.random.key(0))))[0]
    draw = jax.jit(lambda key: adaptation.split(model(key))[1:])
    return graphdef, *draw(jax.random.key(0, impl="rbg"))


def noise(shapes: Any) -> Any:
    """Fill a batch with noise; all masks are true."""

    def fill(leaf: jax.ShapeDtypeStruct) -> jax.Array:
        if leaf.dtype == jnp.float32:
            return jax.random.uniform(jax.random.key(0), leaf.shape, minval=-1)
        return jnp.ones(leaf.shape, leaf.dtype)

    return jax.tree.map(fill, shapes)


class Step:
    """A compiled training step; `load` supplies its arrays.

    Args:
        config: the backbone's config.
        run: the run's config; its batch is spread over the mesh.
        mesh: device mesh; by default only the first device.
        model: the model's shapes; by default those of the run.
        options: compiler options besides those of training.
        loop: take so many steps in a call, as training does; 0: one, without a loop.
    """

    def __init__(
        self,
        config: BackboneConfig,
        run: Config,
        mesh: Mesh | None = None,
        model: Backbone | None = None,
        options: dict[str, str | bool] | None = None,
        loop: int = 0,
    ) -> None:
        mesh = mesh or meshes.make_mesh(devices=jax.devices()[:1])
        optimizer = make_optimizer(run.optim, {run.peft})
        model = model or preflight.abstract_model(run, config)
        graphdef, adapters, frozen = adaptation.split(model)
        self._initial = functools.partial(init_state, optimizer=optimizer)
        self._batch = abstract_batch(config, run.optim.batch_size)
        key = jax.eval_shape(jax.random.key, 1)
        shapes = jax.eval_shape(self._initial, adapters), frozen, self._batch, key
        state, base = (meshes.shardings(tree, mesh) for tree in shapes[:2])
        replicated = meshes.replicated(mesh)
        self._shardings = state, base, meshes.batch_sharding(mesh), replicated
        step = functools.partial(
            train_step,
            graphdef=graphdef,
            optimizer=optimizer,
            weights=auxiliary_weights(run.auxiliary, run.optim.steps),
            parts=run.optim.accumulate,
        )

        def steps(state: Any, *others: Any) -> Any:
            return jax.lax.scan(lambda state, _: step(state, *others), state, length=loop)

        out = state, replicated
        jitted = jax.jit(
            steps if loop else step,
            donate_argnums=0,
            in_shardings=self._shardings,
            out_shardings=out,
        )
        options = (compilation.step_options(mesh.size) or {}) | (options or {})
        self.compiled = jitted.lower(*shapes).compile(options)

    def load(self, adapters: Any, frozen: Any, batch: Any = None) -> "Step":
        """Place the arrays on the devices and return self; the default batch is noise."""
        batch = batch or noise(self._batch)
        arrays = self._initial(adapters), frozen, batch, jax.random.key(1)
        self.state, *self.others = jax.device_put(arrays, self._shardings)
        return self

    def __call__(self) -> Any:
        """Run the next step and return its metrics."""
        self.state, metrics = self.compiled(self.state, *self.others)
        return metrics

    @property
    def bytes(self) -> float:
        """Memory of the program on each device, including its arguments."""
        memory: Any = self.compiled.memory_analysis()
        return memory.argument_size_in_bytes + memory.temp_size_in_bytes


def training(name: str, label: str, run: Config, options: argparse.Namespace, remat: Remat) -> Any:
    """Measure one row of the training table."""
    config = sized(name, options, remat)
    step, size = Step(config, run).load(*arrays(config, run)[1:]), run.optim.batch_size
    seconds = best(step, calls=options.calls)
    operations = preflight.step_flops(run, sized(name, options))
    utilization = flops.utilization(operations, seconds)
    return {
        "backbone": name,
        "trainable": label,
        "base": run.model.base_dtype or options.dtype,
        "batch": size,
        "remat": remat,
        "ms": 1e3 * seconds,
        "samples/s": size / seconds,
        "GiB": step.bytes / GIB,
        "expected": estimate_memory(run, config).peak / GIB,
        "TFLOP": operations / 1e12,
        "MFU": "" if utilization is None else utilization,
    }


def largest(name: str, run: Config, options: argparse.Namespace) -> int:
    """Extrapolate from two batch sizes to the largest one expected to fit in `options.gib` GiB."""
    config = sized(name, options, options.largest_remat)

    def bytes_of(batch: int) -> float:
        optim = dataclasses.replace(run.optim, batch_size=batch)
        return estimate_memory(dataclasses.replace(run, optim=optim), config).peak

    one, nine = bytes_of(1), bytes_of(9)
    per_sample = (nine - one) / 8
    return max(1, int((options.gib * GIB - one + per_sample) / per_sample))


def sampling(name: str, label: str, run: Config | None, options: argparse.Namespace) -> Iterator:
    """Yield the rows of the sampling table."""
    config = sized(name, options)
    sampler = nnx.merge(*arrays(config, run)).sampler()
    observation = noise(abstract_batch(config, 1).observation)

    settings = {"static_argnames": "steps", "compiler_options": sampling_options()}

    @functools.partial(jax.jit, **settings)
    def sample(sampler: Sampler, observation: Any, steps: int) -> jax.Array:
        return sampler.sample_actions(jax.random.key(0), observation, num_steps=steps)

    for batch, steps in itertools.product(options.sampled, options.denoise_steps):
        repeated = jax.tree.map(functools.partial(jnp.repeat, repeats=batch, axis=0), observation)
        call = functools.partial(sample, sampler, repeated, steps=steps)
        row = {"backbone": name, "adapters": label, "batch": batch, "flow steps": steps}
        yield row | {"ms": 1e3 * best(call, calls=1, repeats=10)}


def rows(name: str, table: str, options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield the rows of one backbone in one table."""
    method = peft.LoRASP(rank=options.rank)
    everywhere = run_config(method, ("all-linear",), options.batch, options.base_dtype)
    if table == "training":
        expert = run_config(peft.FullFineTuning(), ("expert-only",), options.batch)
        yield training(name, "LoRA-SP", everywhere, options, options.remat)
        yield training(name, "expert only", expert, options, options.remat)
    elif table == "largest":
        batch = largest(name, everywhere, options)
        run = run_config(method, ("all-linear",), batch, options.base_dtype)
        yield training(name, f"LoRA-SP, {options.gib:g} GiB", run, options, options.largest_remat)
    else:
        yield from sampling(name, "none", None, options)
        yield from sampling(name, "LoRA-SP", everywhere, options)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that define a step and its measurement."""
    parser.add_argument("--rank", type=int, default=128)
    parser.add_argument("--remat", choices=REMATS, default="products")
    parser.add_argument("--unroll", choices=["yes", "no"], help="default: depends on the size")
    parser.add_argument("--dtype", default="bfloat16")
    parser.add_argument("--base-dtype", choices=["", *KINDS], default="")
    parser.add_argument("--calls", type=int, default=5, help="steps queued at once")
    parser.add_argument("--json", type=Path, help="file for the results")


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--backbones", nargs="+", default=list(CAMERAS))
    parser.add_argument("--size", default="base", help="nano, small (not pi05) or base")
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument(
        "--sampled", type=int, nargs="+", default=[1, 8], help="batch sizes for sampling"
    )
    parser.add_argument(
        "--denoise-steps", type=int, nargs="+", default=[10], help="flow steps for sampling"
    )
    parser.add_argument(
        "--gib", type=float, default=24, help="memory [GiB] that the largest batch must fit in"
    )
    parser.add_argument("--largest-remat", choices=REMATS, default="full")
    parser.add_argument("--only", choices=["training", "largest", "sampling"])
    add_options(parser)
    options = parser.parse_args()
    console, results = Console(soft_wrap=True), {"machine": machine("jax")}
    console.print(f"{results['machine']}; {options.size}, rank {options.rank}, {options.dtype}")
    tables: dict[str, list] = {"training": [], "largest": [], "sampling": []}
    for name in options.backbones:
        for table in [options.only] if options.only else tables:
            for row in rows(name, table, options):
                tables[table].append(row)
                write_json(options.json, results | tables)
            print_table(console, [row for row in tables[table] if row["backbone"] == name])


if __name__ == "__main__":
    main()
