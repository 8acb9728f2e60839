"""Compile MuJoCo Warp's kernels for an NVIDIA GPU on a machine that has none.

    python -m studies.warp_ahead press pour --arch 90    # H100, H200

Otherwise, a new GPU machine compiles some 60 modules for minutes before its first physics step.
Here the environments run once on the CPU with launches recorded instead of made, as if they were
on a GPU; the recorded modules are then compiled into Warp's cache (`warp.config.kernel_cache_dir`),
which is to be copied to the same place there. Both need the same versions of Warp and MuJoCo.
"""

import argparse
import inspect
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import warp as wp
from mujoco.mjx.third_party.mujoco_warp._src import collision_convex
from warp._src import context

import envs
from envs import Randomization

_DEFAULT_BLOCK = 256
"""Threads of a block where a launch does not say."""
Modules = dict[tuple[Any, int], None]
"""(module, threads of a block), in the order of their first launch."""


class _Gpu:
    """A Warp device that says of itself that it is a GPU; the rest is the CPU's."""

    is_cuda, is_cpu, sm_count = True, False, 132

    def __init__(self, device: Any) -> None:
        self.device = device

    def __getattr__(self, name: str) -> Any:
        return getattr(self.device, name)


def record() -> Modules:
    """Replace launches by records; return these, which grow as Warp is used.

    Loops and branches of a CUDA graph run their bodies once.
    """
    modules: Modules = {}
    get_device, grid_size = wp.get_device, collision_convex._ccd_grid_size

    def add(kernel: Any, block_dim: int | None = None) -> None:
        modules[kernel.module, block_dim if block_dim and block_dim > 0 else _DEFAULT_BLOCK] = None

    def launch(kernel: Any, dim: Any, inputs: Any = (), outputs: Any = (), **options: Any) -> None:
        del dim
        if kernel.is_generic:
            types = kernel.infer_argument_types([*inputs, *outputs])
            kernel = kernel.add_overload(types)
        add(kernel, options.get("block_dim"))

    def block_size(kernel: Any, device: Any = None) -> tuple[int, int]:
        del device
        add(kernel)
        return _DEFAULT_BLOCK, 2 * _Gpu.sm_count

    def device(name: Any = None) -> Any:
        caller = inspect.stack()[1].frame.f_globals["__name__"]
        found = get_device(name.device if isinstance(name, _Gpu) else name)
        return _Gpu(found) if "mujoco_warp" in caller and name is None else found

    def capture_while(condition: Any, while_body: Any, **options: Any) -> None:
        del condition
        while_body(**options)

    context.launch = wp.launch = launch  # pyright: ignore[reportAttributeAccessIssue]
    context._resolve_launch_block_dim = lambda _, block_dim: block_dim
    wp.get_suggested_block_size = block_size
    wp.get_device = device
    wp.capture_while = capture_while
    wp.is_conditional_graph_supported = lambda: True
    collision_convex._ccd_grid_size = lambda kernel, n, device: grid_size(kernel, n, _Gpu(device))
    return modules


def play(task: str, ranges: Randomization | None, distractors: int) -> None:
    """Reset and step the environment of a task once."""
    env = envs.make(task, num_envs=4, backend="warp", distractors=distractors)
    state = jax.jit(lambda key: env.reset(key, ranges))(jax.random.key(0))
    jax.block_until_ready(jax.jit(env.step)(state, jnp.zeros((4, len(env.action_low)))))


def build(module: Any, block_dim: int, arch: int) -> str:
    """Compile a module into Warp's cache; return the name of its binary."""
    module.get_module_hash(block_dim)
    options, name = module.resolved_options[block_dim], module.get_module_identifier(block_dim)
    binary = module._get_compile_output_name(None, arch, "", False, block_dim=block_dim)
    folder = Path(wp.config.kernel_cache_dir or "") / name  # set by wp.init
    module._compile(None, folder, binary, arch, use_ptx=False, options=options)
    return binary


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("tasks", nargs="+")
    parser.add_argument("--arch", type=int, default=90, help="compute capability, such as 90")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    options = parser.parse_args()
    wp.init()
    modules = record()
    for task in options.tasks:
        play(task, None, 0)
        play(task, Randomization.typical(), 2)
        print(f"{task}: {len(modules)} modules so far", flush=True)
    with ThreadPoolExecutor(options.jobs) as pool:
        jobs = [pool.submit(build, *each, options.arch) for each in modules]
        for job in jobs:
            print(job.result(), flush=True)


if __name__ == "__main__":
    main()
