"""Overhead and throughput of the policy server on this machine, by loopback.

    python -m benchmarks.serving

Overhead is the time of a client's call minus the time that the policy takes for it. Throughput is
that of one client and of eight, each asking as fast as it can. Two policies are served: pi0 nano at
its own image size, and one that only waits for a fixed time per batch, like an accelerator whose
time hardly depends on the batch.
"""

import argparse
import contextlib
import multiprocessing
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.measuring import print_table
from lorasp_jax.extras.serving.client import PolicyClient
from lorasp_jax.extras.serving.requests import PolicySpec, Request
from lorasp_jax.extras.serving.served import ServedPolicies

WARM_UP = 2
"""Calls of each client before the clock starts, as in openpi's example client."""
PERCENTILES = (25, 50, 75, 90, 95, 99)
"""As in the table that openpi's example client prints (examples/simple_client/main.py)."""


class Waiting(ServedPolicies):
    """A policy that waits for a fixed time per batch."""

    def __init__(self, image_size: int, cameras: int, seconds: float) -> None:
        names = tuple(f"camera{i}" for i in range(cameras))
        self.sizes, self._seconds = (1, 2, 4, 8), seconds
        self.spec = PolicySpec(names, image_size, 7, 50)

    @property
    def metadata(self) -> dict[str, Any]:
        """No robot."""
        return {}

    @property
    def instructions(self) -> dict[str, tuple[str, ...]]:
        """The only adapter, trained for no instruction in particular."""
        return {"base": ()}

    @property
    def denoise_steps(self) -> dict[str, int]:
        """No adapter has a flow."""
        return {}

    def route(self, request: Request) -> str:
        """Return the only adapter."""
        del request
        return "base"

    def prepare(self, adapter: str, request: Request, index: tuple[int, int]) -> np.ndarray:
        """Return the state."""
        del adapter, index
        return request.state

    def run(self, adapter: str, rows: Sequence[np.ndarray]) -> tuple[np.ndarray, None]:
        """Return chunks of the states."""
        del adapter
        time.sleep(self._seconds)
        return np.repeat(np.stack(rows)[:, None], self.spec.chunk, axis=1), None


def serve_waiting(image_size: int, cameras: int, seconds: float) -> None:
    """Serve a `Waiting` policy until the process ends; prints the address."""
    import asyncio

    from lorasp_jax.extras.serving.server import PolicyServer, bind

    async def run() -> None:
        port = bind("127.0.0.1", 0)
        async with PolicyServer(Waiting(image_size, cameras, seconds)).listen(port):
            print(f"listening on ws://127.0.0.1:{port.getsockname()[1]}", flush=True)
            await asyncio.Event().wait()

    asyncio.run(run())


def waiting_command(image_size: int, cameras: int, seconds: float) -> list[str]:
    """Return the arguments of a Python process that serves a `Waiting` policy."""
    arguments = f"{image_size}, {cameras}, {seconds}"
    return ["-c", f"from benchmarks.serving import serve_waiting; serve_waiting({arguments})"]


def ask(address: str, calls: int, seed: int, ready: Any, rows: Any) -> None:
    """Make calls as one client; put [call, server, policy] milliseconds of each into `rows`."""
    with PolicyClient(address, timeout=120) as client:
        size, dims = client.metadata["image_size"], client.metadata["action_dim"]
        rng = np.random.default_rng(seed)
        observation = {
            "image": {
                name: rng.integers(0, 255, (size, size, 3), np.uint8)
                for name in client.metadata["cameras"]
            },
            "state": rng.normal(size=dims).astype(np.float32),
            "prompt": "press the red button",
        }
        times = []
        for call in range(WARM_UP + calls):
            if call == WARM_UP:
                ready.wait()
            start = time.perf_counter()
            reply = client.infer(observation)
            milliseconds = (time.perf_counter() - start) * 1e3
            timings = (reply["server_timing"]["infer_ms"], reply["policy_timing"]["infer_ms"])
            times.append([milliseconds, *timings])
        rows.put(times[WARM_UP:])


def run_clients(address: str, clients: int, calls: int) -> tuple[float, np.ndarray]:
    """Run clients at once; return requests per second, and the times `[calls, 3]`."""
    context = multiprocessing.get_context("spawn")
    ready, rows = context.Barrier(clients + 1), context.Queue()
    arguments = [(address, calls, seed, ready, rows) for seed in range(clients)]
    processes = [context.Process(target=ask, args=each) for each in arguments]
    for process in processes:
        process.start()
    ready.wait()
    start = time.perf_counter()
    times = np.concatenate([rows.get() for _ in processes])
    seconds = time.perf_counter() - start
    for process in processes:
        process.join()
    return len(times) / seconds, times


def measure(command: Sequence[str], calls: int) -> list[tuple[float, np.ndarray]]:
    """Measure a server that `command` starts.

    Returns:
        Requests per second and the times of each call `[calls, 3]`, for 1 and for 8 clients.
    """
    with started(command) as address:
        return [run_clients(address, clients, calls) for clients in (1, 8)]


@contextlib.contextmanager
def started(command: Sequence[str]) -> Iterator[str]:
    """Start a server with the arguments of a Python process; yield its address."""
    arguments: Any = {"stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, *command], **arguments) as server:
        try:
            lines = server.stdout or ()
            yield next(line.split()[-1] for line in lines if line.startswith("listening on"))
        finally:
            server.terminate()


def latency_rows(name: str, times: np.ndarray) -> list[dict[str, Any]]:
    """Return the table's rows for one policy; `times` is as in `measure`."""
    total, server, policy = times.T
    parts = {
        "call": total,
        "policy": policy,
        "overhead": total - policy,
        "in server": server - policy,
    }
    return [
        {"policy": name, "ms": part, "mean": float(values.mean()), "std": float(values.std())}
        | {f"p{q}": float(np.percentile(values, q)) for q in PERCENTILES}
        for part, values in parts.items()
    ]


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--calls", type=int, default=500, help="per client")
    parser.add_argument("--milliseconds", type=float, default=20.0, help="of the waiting policy")
    parser.add_argument("--image-size", type=int, default=224)
    parser.add_argument("--cameras", type=int, default=3)
    options = parser.parse_args()
    console = Console()
    nano = ["-m", "lorasp_jax.extras.serving", "assets/pi0_nano", "--joints", "7", "--port", "0"]
    servers = {
        f"wait {options.milliseconds:g} ms": waiting_command(
            options.image_size, options.cameras, options.milliseconds / 1e3
        ),
        "pi0 nano": nano,
    }
    latencies, throughputs = [], []
    for name, command in servers.items():
        (one, times), (eight, times_of_eight) = measure(command, options.calls)
        latencies += latency_rows(name, times)
        throughputs.append(
            {
                "policy": name,
                "1 client": one,
                "8 clients": eight,
                "ratio": eight / one,
                "policy ms, 1": float(np.median(times[:, 2])),
                "8": float(np.median(times_of_eight[:, 2])),
            }
        )
    print_table(console, latencies, "latency of one client")
    print_table(console, throughputs, "requests per second")


if __name__ == "__main__":
    main()
