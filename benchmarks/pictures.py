"""JPEG in place of raw pictures: bytes, time, calls over a slow link, and success in simulation.

    python -m benchmarks.pictures --episodes 64

The link is emulated by a proxy on this machine that delays and throttles a TCP stream in both
directions. Success is that of a bundled base on its own robot, with the same layouts and the same
noise for every quality; pictures and requests take the server's way.
"""

import argparse
import asyncio
import threading
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

import envs
from benchmarks.measuring import machine, print_table
from benchmarks.serving import WARM_UP, started, waiting_command
from lorasp_jax.base import compilation_cache
from lorasp_jax.base.intervals import wilson_interval
from lorasp_jax.extras.serving import jpeg, requests, wire
from lorasp_jax.extras.serving.client import PolicyClient
from lorasp_jax.extras.serving.loading import UNADAPTED, load_checkpoint
from lorasp_jax.extras.serving.policies import CompiledPolicy
from lorasp_jax.extras.serving.served import ServedPolicies

SIZE, CAMERAS = 224, 3  # pixels, as openpi's models; a usual number
EXECUTE = 5  # actions of a chunk, as evaluations


class Link:
    """A TCP proxy that lets bytes through at a rate and after a delay, as a wireless link would.

    Attributes:
        port: of this machine, where it listens while the context is open.
    """

    def __init__(self, port: int, *, bits: float, round_trip: float) -> None:
        """Lead to a port of this machine with a rate [bit/s] and a time there and back [s]."""
        self._target, self._rate, self._delay = port, bits / 8, round_trip / 2
        self._loop = asyncio.new_event_loop()

    def __enter__(self) -> "Link":
        """Start."""
        opening = asyncio.start_server(self._connect, "127.0.0.1", 0)
        server = self._loop.run_until_complete(opening)
        self.port: int = server.sockets[0].getsockname()[1]
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop; connections end with the process."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection("127.0.0.1", self._target)
        await asyncio.gather(self._pump(reader, back), self._pump(there, writer))

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Pass one direction on; bytes wait for those before them, so a burst takes its time."""
        free = self._loop.time()
        while data := await reader.read(1500):  # a packet
            free = max(free, self._loop.time()) + len(data) / self._rate
            self._loop.call_at(free + self._delay, writer.write, data)
        self._loop.call_at(free + self._delay, writer.close)


def rendered(size: int, number: int) -> list[np.ndarray]:
    """Return pictures of the task press, uint8 `[size, size, 3]`."""
    env = envs.make("press", robot="panda", num_envs=number, image_size=size)
    views = jax.jit(env.observe)(jax.jit(env.reset)(jax.random.key(0)))["image"]
    return [np.asarray(view[world]) for world in range(number) for view in views.values()][:number]


def costs(observation: dict[str, Any], quality: int | None) -> dict[str, Any]:
    """Return the bytes of a call, and the milliseconds that its pictures take at both ends."""
    if not quality:
        return {"kB a call": len(wire.pack(observation)) / 1e3, "encode ms": 0.0, "decode ms": 0.0}
    sent, times = observation, np.zeros((50, 2))
    for row in times:
        start = time.perf_counter()
        sent = jpeg.compress(observation, quality)
        middle = time.perf_counter()
        for name, picture in sent["image"].items():
            jpeg.decode(name, picture)
        row[:] = middle - start, time.perf_counter() - middle
    encode, decode = map(float, np.median(times, 0) * 1e3)
    return {"kB a call": len(wire.pack(sent)) / 1e3, "encode ms": encode, "decode ms": decode}


def calls(address: str, observation: dict[str, Any], quality: int | None, number: int) -> float:
    """Return the median time of a call [ms]."""
    with PolicyClient(address, timeout=120, jpeg=quality) as client:
        times = []
        for _ in range(WARM_UP + number):
            start = time.perf_counter()
            client.infer(observation)
            times.append((time.perf_counter() - start) * 1e3)
    return float(np.median(times[WARM_UP:]))


def over_link(
    observation: dict[str, Any],
    qualities: list[int | None],
    *,
    number: int,
    bits: float,
    round_trip: float,
) -> list[float]:
    """Return the times of calls [ms] over a link, to a server whose policy takes 20 ms."""
    with started(waiting_command(SIZE, CAMERAS, 0.02)) as server:
        port = int(server.rpartition(":")[2])
        with Link(port, bits=bits, round_trip=round_trip) as link:
            address = f"ws://127.0.0.1:{link.port}"
            return [calls(address, observation, each, number) for each in qualities]


class Closed:
    """A served policy and parallel worlds of its robot, in a closed loop."""

    def __init__(self, base: str, task: str, worlds: int) -> None:
        """Load a bundled base and make the worlds."""
        loaded = load_checkpoint(base, joints=7)[UNADAPTED]
        policy = CompiledPolicy(loaded, max_batch=worlds)
        self._served = ServedPolicies({UNADAPTED: policy})
        size = self._served.spec.image_size
        self._env = envs.make(task, robot="panda", num_envs=worlds, image_size=size)
        self._reset, self._observe = jax.jit(self._env.reset), jax.jit(self._env.observe)
        advance = lambda state, action: (self._env.step(state, action), None)  # noqa: E731
        self._act = jax.jit(lambda state, chunk: jax.lax.scan(advance, state, chunk)[0])

    def run(self, seed: int, quality: int | None) -> np.ndarray:
        """Return the success of each world, bool `[W]`."""
        state, env, spec = self._reset(jax.random.key(seed)), self._env, self._served.spec
        adapter = self._served.adapters[0]
        prompts = [env.instructions[row] for row in np.asarray(state.info["instruction"])]
        for call in range(-(-env.max_steps // EXECUTE)):
            seen = jax.tree.map(np.asarray, self._observe(state))
            rows = []
            for world, prompt in enumerate(prompts):
                images = {name: view[world] for name, view in seen["image"].items()}
                message = {"image": images, "state": seen["state"][world], "prompt": prompt}
                if quality:
                    message = jpeg.compress(message, quality)
                index = seed * len(prompts) + world, call
                rows.append(self._served.prepare(adapter, requests.parse(message, spec), index))
            chunk, _ = self._served.run(adapter, rows)
            state = self._act(state, jnp.moveaxis(chunk[:, :EXECUTE], 1, 0))
            if np.asarray(state.done).all():
                break
        return np.asarray(state.info["success"])


def success(
    closed: Closed, qualities: list[int | None], batches: int, console: Console
) -> list[np.ndarray]:
    """Return the success of every episode for each quality, bool `[episodes]`."""
    found: list[list[np.ndarray]] = [[] for _ in qualities]
    for seed in range(batches):
        for runs, quality in zip(found, qualities, strict=True):
            runs.append(closed.run(seed, quality))
        console.print(f"batch {seed + 1} of {batches}: {[int(runs[-1].sum()) for runs in found]}")
    return [np.concatenate(runs) for runs in found]


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    add = parser.add_argument
    add("--qualities", type=int, nargs="+", default=[75, 90, 95])
    add("--calls", type=int, default=20, help="per quality, over the link")
    add("--megabits", type=float, default=10.0, help="of the link, per second")
    add("--round-trip", type=float, default=80.0, help="of the link [ms]")
    add("--base", default="assets/pi0_nano")
    add("--task", default="press")
    add("--episodes", type=int, default=256, help="per quality; a multiple of --worlds, or 0")
    add("--worlds", type=int, default=32)
    options = parser.parse_args()
    console, qualities = Console(), [None, *options.qualities]
    compilation_cache.enable()
    console.print(machine("jax", "pillow"))
    pictures = rendered(SIZE, CAMERAS)
    images = {f"camera{number}": picture for number, picture in enumerate(pictures)}
    observation = {"image": images, "state": np.zeros(7, np.float32), "prompt": "press the button"}
    link = {"bits": options.megabits * 1e6, "round_trip": options.round_trip / 1e3}
    times = over_link(observation, qualities, number=options.calls, **link)
    rows = [
        {"quality": quality or "raw", **costs(observation, quality), "link ms": ms}
        for quality, ms in zip(qualities, times, strict=True)
    ]
    print_table(console, rows, f"a call with {CAMERAS} pictures of {SIZE} px; policy 20 ms")
    if not options.episodes:
        return
    closed = Closed(options.base, options.task, options.worlds)
    outcomes = success(closed, qualities, options.episodes // options.worlds, console)
    print_table(
        console,
        [_row(name, each, outcomes[0]) for name, each in zip(qualities, outcomes, strict=True)],
        options.task,
    )


def _row(quality: int | None, outcome: np.ndarray, raw: np.ndarray) -> dict[str, Any]:
    low, high = wilson_interval(int(outcome.sum()), len(outcome))
    row = {"quality": quality or "raw", "success %": float(100 * outcome.mean())}
    row |= {"from": 100 * low, "to": 100 * high, "episodes": len(outcome)}
    return {**row, "lost": int((raw & ~outcome).sum()), "won": int((~raw & outcome).sum())}


if __name__ == "__main__":
    main()
