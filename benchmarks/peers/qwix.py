"""qwix's LoRA and QLoRA (JAX) on a stack of dense layers."""

from collections.abc import Iterator

from flax import nnx

from benchmarks.peers import stacks, worker, workloads
from benchmarks.peers.worker import Job, Row

PACKAGES = ("qwix", "jax", "flax")
NF4 = {"weight_qtype": "nf4", "tile_size": 64}
"""64 weights share a scale, as in this project's nf4."""


def measure(job: Job) -> Iterator[Row]:
    """Yield the rows of one job."""
    import qwix  # pyright: ignore[reportMissingImports]

    sizes = workloads.STACK[job.size]
    x = stacks.inputs(sizes)
    options = NF4 if job.variant.endswith("nf4") else {}
    provider = qwix.LoraProvider(
        module_path=".*", rank=sizes.rank, alpha=2.0 * sizes.rank, **options
    )
    base = stacks.Stack(sizes.depth, sizes.width)
    model = qwix.apply_lora_to_model(base, provider, x, rngs=nnx.Rngs(0))
    yield from stacks.rows(model, x, job)


if __name__ == "__main__":
    worker.main(measure, worker.jax_device, PACKAGES)
