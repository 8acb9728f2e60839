"""Whether worlds can go on for ever: randomised expert episodes one after the other.

    python -m benchmarks.long_run --tasks pour --backend warp --episodes 200 --num-envs 256

For each task, after each fifth of the episodes: the share that the experts solved, worlds that
broke (were ended because a position or velocity was not finite), and the memory of host and device.
The exit code is 1 where a world broke or memory grew by more than 2 % after the first fifth.
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
from envs.compilation import cache
from envs.env import Env
from envs.experts import expert
from envs.physics import physics
from envs.state import State

PARTS = 5
MOST_GROWTH = 1.02


@dataclasses.dataclass
class Found:
    """What `run` has seen so far.

    Attributes:
        episodes: of every world.
        success: share that the experts solved.
        broken: those that were ended because a value was not finite.
        memory: [MiB] by its owner.
        seconds: since the first.
    """

    episodes: int
    success: float
    broken: int
    memory: dict[str, float]
    seconds: float

    def __str__(self) -> str:
        held = ", ".join(f"{name} {mib:.1f}" for name, mib in self.memory.items())
        return (
            f"{self.episodes} episodes in {self.seconds:.0f} s, success {self.success:.4f}, "
            f"broken {self.broken}, MiB: {held}"
        )


def passed(parts: list[Found]) -> bool:
    """Whether nothing broke, and no memory grew after the first part."""
    first, last = parts[0].memory, parts[-1].memory
    return not parts[-1].broken and all(last[k] <= MOST_GROWTH * first[k] for k in first)


def run(env: Env, episodes: int) -> Iterator[Found]:
    """Consecutive episodes of the expert in all worlds, each with a picture at its end."""
    ranges = Randomization.typical()

    @jax.jit
    def episode(state: State, key: jax.Array) -> tuple[State, dict[str, jax.Array]]:
        # A world whose expert has run out of waypoints, but not of the task's time, restarts too.
        state = dataclasses.replace(state, done=jnp.ones(env.num_envs, bool))
        state = env.reset_done(state, key, ranges)
        plan = expert.plan(env, state, key)

        def body(state: State, _: None) -> tuple[State, None]:
            return env.step(state, expert.act(env, plan, state)), None

        state = jax.lax.scan(body, state, length=env.expert_steps)[0]
        pictures = {name: image.mean() for name, image in env.observe(state)["image"].items()}
        return state, pictures | {k: state.info[k].sum() for k in ("success", "broken")}

    state, begun = env.reset(jax.random.key(0), ranges), time.perf_counter()
    success = broken = 0
    for number in range(1, episodes + 1):
        state, seen = episode(state, jax.random.key(number))
        success, broken = success + int(seen["success"]), broken + int(seen["broken"])
        if number * PARTS // episodes > (number - 1) * PARTS // episodes:
            share, seconds = success / (env.num_envs * number), time.perf_counter() - begun
            yield Found(number, share, broken, memory(env), seconds)


def memory(env: Env) -> dict[str, float]:
    """What the process holds now, in MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    held: dict[str, float] = {"host": pages * 4096 / 2**20}
    if of_device := jax.devices()[0].memory_stats():  # None on CPU
        held["JAX"] = of_device["bytes_in_use"] / 2**20
    if mib := measuring.warp_mib(env.physics.backend):
        held["Warp"] = mib
    return held


def main(arguments: list[str] | None = None) -> int:
    """Run, print; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--tasks", nargs="+", default=["open_pot", "pour", "press", "pick_place"])
    parser.add_argument("--robot", default="piper")
    parser.add_argument("--backend", help="default: warp where it is picked, else jax")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--num-envs", type=int, default=256)
    options = parser.parse_args(arguments)
    if options.episodes < PARTS:
        parser.error(f"--episodes must be at least {PARTS}, to see whether memory grows")
    cache.enable()
    backend: Any = options.backend or physics.default_backend()
    console, good = Console(soft_wrap=True), True
    for task in options.tasks:
        env = envs.make(
            task, options.robot, num_envs=options.num_envs, backend=backend, distractors=2
        )
        parts = []
        for part in run(env, options.episodes):
            console.print(f"{task}, {options.robot}, {backend}, {env.num_envs} worlds: {part}")
            parts.append(part)
        good &= passed(parts)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
