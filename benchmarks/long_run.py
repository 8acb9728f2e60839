"""Endurance test: many randomized expert episodes in a row, checking physics and memory.

    python -m benchmarks.long_run --tasks pour --backend warp --episodes 200 --num-envs 256

A line after each fifth of a task's episodes reports the success rate, the number of broken worlds,
and host and device memory. A world is broken once a position or velocity is not finite. The exit
code is 1 if a world broke, or if memory grew by more than 2 % after the first fifth.
"""

import argparse
import dataclasses
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from rich.console import Console

import envs
from benchmarks import measuring
from envs import Randomization
from envs.env import Env
from envs.experts import expert
from envs.physics import physics
from envs.state import State
from lorasp_jax.base import compilation_cache as cache

PARTS = 5
MAX_GROWTH = 1.02  # memory relative to that after the first part; chosen above allocator noise


@dataclasses.dataclass
class Report:
    """Results of `run` so far.

    Attributes:
        episodes: episodes per world.
        success: fraction of episodes that the expert solved.
        broken: number of worlds that broke.
        memory: memory by allocator [MiB].
        seconds: time since the first episode.
    """

    episodes: int
    success: float
    broken: int
    memory: dict[str, float]
    seconds: float

    def __str__(self) -> str:
        memory = ", ".join(f"{name} {mib:.1f}" for name, mib in self.memory.items())
        return (
            f"{self.episodes} episodes in {self.seconds:.0f} s, success {self.success:.4f}, "
            f"broken {self.broken}, MiB: {memory}"
        )


def passed(parts: list[Report]) -> bool:
    """Return whether no world broke and no memory grew beyond `MAX_GROWTH`."""
    first, last = parts[0].memory, parts[-1].memory
    return not parts[-1].broken and all(last[k] <= MAX_GROWTH * first[k] for k in first)


def run(env: Env, episodes: int) -> Iterator[Report]:
    """Run consecutive expert episodes in all worlds, rendering at the end of each episode."""
    ranges = Randomization.typical()

    @jax.jit
    def episode(state: State, key: jax.Array) -> tuple[State, dict[str, jax.Array]]:
        # Restart all worlds, including those whose expert finished before the time limit.
        state = dataclasses.replace(state, done=jnp.ones(env.num_envs, bool))
        reset_key, plan_key = jax.random.split(key)
        state = env.reset_done(state, reset_key, ranges)
        plan = expert.plan(env, state, plan_key)

        def body(state: State, _: None) -> tuple[State, None]:
            return env.step(state, expert.act(env, plan, state)), None

        state = jax.lax.scan(body, state, length=env.expert_steps)[0]
        images = {name: image.mean() for name, image in env.observe(state)["image"].items()}
        return state, images | {k: state.info[k].sum() for k in ("success", "broken")}

    state, start = env.reset(jax.random.key(0), ranges), time.perf_counter()
    success = broken = 0
    for number in range(1, episodes + 1):
        state, sums = episode(state, jax.random.key(number))
        success, broken = success + int(sums["success"]), broken + int(sums["broken"])
        if number * PARTS // episodes > (number - 1) * PARTS // episodes:
            rate, seconds = success / (env.num_envs * number), time.perf_counter() - start
            yield Report(number, rate, broken, memory(env), seconds)


def memory(env: Env) -> dict[str, float]:
    """Return the memory in use [MiB], by allocator."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    used: dict[str, float] = {"host": pages * 4096 / 2**20}
    if stats := jax.devices()[0].memory_stats():  # None on CPU
        used["JAX"] = stats["bytes_in_use"] / 2**20
    if mib := measuring.warp_mib(env.physics.backend):
        used["Warp"] = mib
    return used


def main(arguments: list[str] | None = None) -> int:
    """Run the test from the command line and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--tasks", nargs="+", default=["open_pot", "pour", "press", "pick_place"])
    parser.add_argument("--robot", default="piper")
    parser.add_argument("--backend", help="default: warp on a single NVIDIA GPU, else jax")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--num-envs", type=int, default=256)
    options = parser.parse_args(arguments)
    if options.episodes < PARTS:
        parser.error(f"--episodes must be at least {PARTS} to measure memory growth")
    cache.enable()
    backend: Any = options.backend or physics.default_backend()
    console, all_passed = Console(soft_wrap=True), True
    for task in options.tasks:
        env = envs.make(
            task, options.robot, num_envs=options.num_envs, backend=backend, distractors=2
        )
        parts = []
        for part in run(env, options.episodes):
            console.print(f"{task}, {options.robot}, {backend}, {env.num_envs} worlds: {part}")
            parts.append(part)
        all_passed &= passed(parts)
    return 0 if all_passed else 1


if __name__ == "__main__":
    sys.exit(main())
