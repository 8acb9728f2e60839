"""Time that image augmentation adds to a training step.

python -m benchmarks.augmentation
python -m benchmarks.augmentation --batch 4 --cameras 1 --size 64    # on a CPU
"""

import argparse
import functools

import jax
import jax.numpy as jnp
from rich.console import Console

from benchmarks.measuring import best, machine, print_table
from lorasp_jax.config import AugmentConfig
from lorasp_jax.data.augmentation import recipe


def main() -> None:
    """Print milliseconds per step for both recipes."""
    parser = argparse.ArgumentParser(
        description="Time that image augmentation adds to a training step."
    )
    parser.add_argument("--batch", type=int, default=32, help="images per camera")
    parser.add_argument("--cameras", type=int, default=3, help="the last one is on the wrist")
    parser.add_argument("--size", type=int, default=224, help="height and width [px]")
    options = parser.parse_args()
    console = Console()
    console.print(machine("jax", "augmax"), highlight=False)
    shape = (options.cameras, options.batch, options.size, options.size, 3)
    images = jax.jit(functools.partial(jax.random.uniform, shape=shape))(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), shape[:2])
    rows = []
    for preset in ("openpi", "lerobot"):
        settings = AugmentConfig(preset)  # type: ignore[arg-type]
        wrists = [camera == options.cameras - 1 > 0 for camera in range(options.cameras)]
        changes = [jax.vmap(recipe(settings, wrist=wrist)) for wrist in wrists]

        @jax.jit
        def augment(keys: jax.Array, images: jax.Array, changes: list = changes) -> jax.Array:
            return jnp.stack([f(k, x) for f, k, x in zip(changes, keys, images, strict=True)])

        seconds = best(functools.partial(augment, keys, images), calls=10)
        rows.append({"recipe": preset, "ms": 1e3 * seconds})
    print_table(console, rows)


if __name__ == "__main__":
    main()
