"""How fast the environments are, next to MuJoCo's C engine and MuJoCo Playground on this machine.

    python -m benchmarks.envs --batches 256 1024 4096 --json envs.json

For each task and batch: seconds to compile, physics steps/s, control steps/s without and with the
pictures of both cameras, images/s of the renderer alone (hard shadows, two cameras), memory of the
compiled program, and the ratio to MuJoCo's C engine with a thread a core on the same scene. Actions
are noise around the start pose. Inputs are built under jit, everything is warmed up twice, the best
of three calls counts.
"""

import argparse
import copy
import importlib.metadata
import importlib.util
import json
import os
import platform
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

import envs
from envs import physics, render
from envs.env import Env
from envs.state import State

CONTROL_STEPS = 10  # to a timed call
C_STEPS = 500  # physics steps to a timed call of the C engine
PICTURE_SIZES = (64, 128)  # [px] of the renderer's columns
PLAYGROUND = "PandaPickCube"


def measure(task: str, options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The rows of one task, one a batch size."""
    reference = None  # does not depend on the batch
    for batch in options.batches:
        env = envs.make(task, options.robot, num_envs=batch, image_size=options.image_size)
        state = env.reset(jax.random.key(0))
        reference = reference or mujoco_c(env, state)
        yield measure_batch(env, state, reference)


def measure_batch(env: Env, state: State, reference: float) -> dict[str, Any]:
    """One row of the table, given the C engine's physics steps/s."""
    blind, compile_seconds, memory = time_steps(env, state, pictures=False)
    seeing, _, _ = time_steps(env, state, pictures=True)
    steps = blind * round(env.control_dt / env.physics_dt)
    return {
        "task": env.task.name,
        "batch": env.num_envs,
        "compile [s]": compile_seconds,
        "physics steps/s": steps,
        "control steps/s": blind,
        "with pictures": seeing,
        **{f"images/s, {n} px": time_pictures(env, state, n) for n in PICTURE_SIZES},
        "memory [MiB]": memory,
        "over MuJoCo C": steps / reference,
    }


def time_steps(env: Env, state: State, *, pictures: bool) -> tuple[float, float, float]:
    """Control steps/s of all worlds together, seconds to compile, temporary memory in MiB."""
    middle = state.info["command"]

    def run(state: State, key: jax.Array) -> tuple[State, Any]:
        def body(state: State, key: jax.Array) -> tuple[State, Any]:
            state = env.step(state, middle + 0.1 * jax.random.normal(key, middle.shape))
            # Sums, so that every picture is made and none is kept.
            return state, jax.tree.map(jnp.sum, env.observe(state)) if pictures else None

        return jax.lax.scan(body, state, jax.random.split(key, CONTROL_STEPS))

    key = jax.random.key(1)
    start = time.perf_counter()
    compiled = jax.jit(run).lower(state, key).compile()
    compile_seconds = time.perf_counter() - start
    analysis: Any = compiled.memory_analysis()
    memory = analysis.temp_size_in_bytes / 2**20
    seconds = best(lambda: compiled(state, key))
    return env.num_envs * CONTROL_STEPS / seconds, compile_seconds, memory


def time_pictures(env: Env, state: State, size: int) -> float:
    """Images/s of the renderer alone, all worlds and both cameras, `size` x `size` px."""
    data = state.data
    poses = (data.geom_xpos, data.geom_xmat, data.cam_xpos, data.cam_xmat)
    draw = jax.jit(
        lambda poses: render.render_batch(
            env.render_model, *poses, height=size, width=size, samples=env.antialias
        )
    )
    return env.num_envs * len(env.cameras) / best(lambda: draw(poses))


def best(call: Callable[[], Any]) -> float:
    """Seconds of the fastest of three calls, after two to warm up."""
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - start)
    return min(seconds[2:])


def mujoco_c(env: Env, state: State) -> float:
    """Physics steps/s of MuJoCo's C engine from the same start, one thread a core."""
    cores = os.cpu_count() or 1
    model = copy.copy(env.model)
    for name, place in state.info["layout"].items():
        model.body_pos[model.body(name).id] = np.asarray(place[0, :3])
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


def playground(batch: int) -> float:
    """Physics steps/s of MuJoCo Playground's environment with default settings."""
    from mujoco_playground import registry  # pyright: ignore[reportMissingImports]

    env = registry.load(PLAYGROUND)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), batch))

    def run(state: Any, key: jax.Array) -> Any:
        def body(state: Any, key: jax.Array) -> tuple[Any, None]:
            actions = 0.1 * jax.random.normal(key, (batch, env.action_size))
            return jax.vmap(env.step)(state, actions), None

        return jax.lax.scan(body, state, jax.random.split(key, CONTROL_STEPS))[0]

    compiled = jax.jit(run).lower(state, jax.random.key(1)).compile()
    seconds = best(lambda: compiled(state, jax.random.key(1)))
    return batch * CONTROL_STEPS * round(env.dt / env.sim_dt) / seconds


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--tasks", nargs="+", default=["open_pot", "pour", "press", "pick_place"])
    parser.add_argument("--robot", default="piper")
    parser.add_argument("--batches", nargs="+", type=int, default=[16])
    parser.add_argument("--image-size", type=int, default=64)
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    physics.enable_fast_cpu()
    console = Console()
    versions = {p: importlib.metadata.version(p) for p in ("jax", "mujoco", "mujoco-mjx")}
    machine = f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores, Python "
    machine += f"{platform.python_version()}, {versions}, pictures {options.image_size} px"
    console.print(machine)
    rows = []
    for task in options.tasks:
        for row in measure(task, options):
            rows.append(row)
            console.print(", ".join(f"{k} {_text(v)}" for k, v in row.items()))
    print_tables(console, rows)
    found: dict[str, Any] = {"machine": machine, "rows": rows}
    if importlib.util.find_spec("mujoco_playground"):
        found[PLAYGROUND] = {batch: playground(batch) for batch in options.batches}
        console.print(f"Playground's {PLAYGROUND}, physics steps/s by batch: {found[PLAYGROUND]}")
    else:
        console.print(f"mujoco_playground is not installed: no figures of its {PLAYGROUND}")
    if options.json:
        options.json.write_text(json.dumps(found, indent=1))


def print_tables(console: Console, rows: list[dict[str, Any]]) -> None:
    """Steps and pictures apart, which fits 80 columns."""
    images = [name for name in rows[0] if name.startswith("images/s")]
    steps = [name for name in rows[0] if name not in images]
    for names in (steps, ["task", "batch", *images]):
        table = Table(*map(escape, names), box=box.SIMPLE, pad_edge=False)
        table.columns[0].no_wrap = True
        for row in rows:
            table.add_row(*(_text(row[name]) for name in names))
        console.print(table)


def _text(value: Any) -> str:
    if not isinstance(value, float):
        return str(value)
    if value >= 1e6:
        return f"{value / 1e6:.2f} M"
    return f"{value:,.3g}" if value < 100 else f"{value:,.0f}"


if __name__ == "__main__":
    main()
