"""Speed of the environments, compared with MuJoCo's C engine and MuJoCo Playground on this machine.

    python -m benchmarks.envs --batches 256 1024 4096 --json envs.json

Each row is one task, backend and batch size:

- compile s: compile time, with `--jobs` programs compiling at once
- physics/s, control/s: physics steps and control steps, without rendering
- control+images/s: control steps, with both cameras rendered in each
- images/s: the ray caster alone, with both cameras and hard shadows
- MiB: temporary memory of the program, plus Warp's
- over C: physics/s relative to MuJoCo's C engine on the same scene, with one thread per core

Actions are noise around the start pose. Times are the best of three calls after two warm-ups.
"""

import argparse
import dataclasses
import importlib.util
import itertools
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Self

import jax
import mujoco
import mujoco.rollout
import numpy as np
from rich.console import Console

import envs
from benchmarks import measuring
from benchmarks.measuring import best, print_table, text, write_json
from envs.env import Env
from envs.physics import physics
from envs.rendering.renderer import RayRenderer
from envs.scene import placing
from envs.state import Poses, State

CONTROL_STEPS = 10  # per timed call
C_STEPS = 500  # physics steps per timed call of the C engine
IMAGE_SIZES = (64, 128)  # px, in the columns images/s
PLAYGROUND, PLAYGROUND_CONTACTS = "PandaPickCube", 24  # contacts per world: Playground's default


@dataclasses.dataclass
class Case:
    """One row of the table: an environment and the compiled program that steps it."""

    env: Env
    state: State
    steps: Any  # (state, key) -> state after CONTROL_STEPS steps
    compile_seconds: float

    @classmethod
    def prepare(cls, options: argparse.Namespace, task: str, backend: Any, batch: int) -> Self:
        """Create the environment and compile its program."""
        env = envs.make(
            task, options.robot, num_envs=batch, image_size=options.image_size, backend=backend
        )
        state = env.reset(jax.random.key(0))
        start_command = state.info["command"]

        def run(state: State, key: jax.Array) -> State:
            def body(state: State, key: jax.Array) -> tuple[State, None]:
                noise = jax.random.normal(key, start_command.shape)
                return env.step(state, start_command + 0.1 * noise), None

            return jax.lax.scan(body, state, jax.random.split(key, CONTROL_STEPS))[0]

        start = time.perf_counter()
        steps = jax.jit(run).lower(state, jax.random.key(1)).compile()
        return cls(env, state, steps, time.perf_counter() - start)

    def measure(self, reference: float) -> dict[str, Any]:
        """Measure the row; `reference` is the C engine's physics steps/s."""
        env = self.env
        start = time.perf_counter()
        jax.block_until_ready(self.steps(self.state, jax.random.key(1)))
        first = time.perf_counter() - start  # Warp compiles its kernels here
        stepping = best(lambda: self.steps(self.state, jax.random.key(1))) / CONTROL_STEPS
        rendering = best(lambda: env.observe(self.state))
        physics_steps = env.num_envs * round(env.control_dt / env.physics_dt) / stepping
        return {
            "task": env.task.name,
            "backend": env.physics.backend,
            "batch": env.num_envs,
            "compile s": self.compile_seconds + first - CONTROL_STEPS * stepping,
            "physics/s": physics_steps,
            "control/s": env.num_envs / stepping,
            "control+images/s": env.num_envs / (stepping + rendering),
            **{f"images/s, {n} px": time_images(env, self.state, n) for n in IMAGE_SIZES},
            "MiB": self.memory(),
            "over C": physics_steps / reference,
        }

    def memory(self) -> float:
        """Return the program's temporary memory plus Warp's allocations, in MiB."""
        temporary: int = self.steps.memory_analysis().temp_size_in_bytes
        return temporary / 2**20 + measuring.warp_mib(self.env.physics.backend)


def time_images(env: Env, state: State, size: int) -> float:
    """Measure images/s of the ray caster alone: all worlds, both cameras, `size` x `size` px."""
    poses = Poses.of(state.data)
    rays = RayRenderer(env.render_model, size, samples=1)
    draw = jax.jit(lambda poses: rays(poses, None, None))
    return env.num_envs * len(env.cameras) / best(lambda: draw(poses))


def mujoco_c(env: Env, state: State) -> float:
    """Measure physics steps/s of MuJoCo's C engine from the same state, one thread per core."""
    cores = os.cpu_count() or 1
    model = placing.world_model(env.model, state.info["layout"], 0)
    data = [mujoco.MjData(model) for _ in range(cores)]
    data[0].qpos[:] = np.asarray(state.data.qpos[0])
    spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
    first = np.empty(mujoco.mj_stateSize(model, spec))
    mujoco.mj_getState(model, data[0], first, spec)
    worlds = np.tile(first, (4 * cores, 1))
    command = np.asarray(state.info["command"][0]) * np.append(np.ones(env.num_joints), 0.5)
    control = np.broadcast_to(command, (len(worlds), C_STEPS, len(command))).copy()
    seconds = best(lambda: mujoco.rollout.rollout(model, data, worlds, control)[0])
    return len(worlds) * C_STEPS / seconds


def playground(backend: Any, batch: Any) -> tuple[Callable[[], Any], int]:
    """Compile MuJoCo Playground's `PLAYGROUND`, with enough memory for each world's contacts.

    Returns:
        A compiled call, and its number of physics steps over all worlds.
    """
    from mujoco_playground import registry  # pyright: ignore[reportMissingImports]

    contacts = PLAYGROUND_CONTACTS * batch
    overrides = {"impl": backend, "naconmax": contacts, "naccdmax": contacts}
    env = registry.load(PLAYGROUND, config_overrides=overrides)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), batch))

    def run(state: Any, key: jax.Array) -> Any:
        def body(state: Any, key: jax.Array) -> tuple[Any, None]:
            actions = 0.1 * jax.random.normal(key, (batch, env.action_size))
            return jax.vmap(env.step)(state, actions), None

        return jax.lax.scan(body, state, jax.random.split(key, CONTROL_STEPS))[0]

    compiled = jax.jit(run).lower(state, jax.random.key(1)).compile()
    steps = batch * CONTROL_STEPS * round(env.dt / env.sim_dt)
    return lambda: compiled(state, jax.random.key(1)), steps


def measure_playground(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield the rows of MuJoCo Playground, one per backend and batch size."""
    cases = list(itertools.product(options.backends, options.batches))
    with ThreadPoolExecutor(options.jobs) as pool:
        prepared = list(pool.map(lambda names: playground(*names), cases))
    for (backend, batch), (call, steps) in zip(cases, prepared, strict=True):
        yield {"backend": backend, "batch": batch, "physics/s": steps / best(call)}


def measure(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield the rows, one per task, backend and batch size."""
    cases = itertools.product(options.tasks, options.backends, options.batches)
    references: dict[str, float] = {}
    with ThreadPoolExecutor(options.jobs) as pool:
        for case in list(pool.map(lambda names: Case.prepare(options, *names), cases)):
            task = case.env.task.name
            if task not in references:
                references[task] = mujoco_c(case.env, case.state)
            yield case.measure(references[task])


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--tasks", nargs="+", default=["open_pot", "pour", "press", "pick_place"])
    parser.add_argument("--robot", default="piper")
    parser.add_argument(
        "--backends", nargs="+", help="default: jax, plus warp on a single NVIDIA GPU"
    )
    parser.add_argument("--batches", nargs="+", type=int, default=[16])
    parser.add_argument("--image-size", type=int, default=64)
    parser.add_argument("--jobs", type=int, default=1, help="programs to compile at once")
    parser.add_argument("--json", type=Path, help="file for the results")
    options = parser.parse_args()
    options.backends = options.backends or sorted({"jax", physics.default_backend()})
    console = Console()
    machine = measuring.machine("jax", "mujoco", "mujoco-mjx")
    machine += f", images {options.image_size} px"
    console.print(machine)
    rows = []
    for row in measure(options):
        rows.append(row)
        console.print(", ".join(f"{k} {text(v)}" for k, v in row.items()))
    images = [name for name in rows[0] if name.startswith("images/s")]
    print_table(console, [{k: v for k, v in row.items() if k not in images} for row in rows])
    names = ["task", "backend", "batch", *images]
    print_table(console, [{name: row[name] for name in names} for row in rows])
    results: dict[str, Any] = {"machine": machine, "rows": rows}
    if importlib.util.find_spec("mujoco_playground"):
        results[PLAYGROUND] = list(measure_playground(options))
        print_table(console, results[PLAYGROUND], f"MuJoCo Playground's {PLAYGROUND}")
    else:
        console.print(f"mujoco_playground is not installed: skipping its {PLAYGROUND}")
    write_json(options.json, results)


if __name__ == "__main__":
    main()
