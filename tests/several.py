"""Start several processes of one run on this machine."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from tests import ROOT, xla

NAMES = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")


def free_address() -> str:
    """Return an unused address on this machine."""
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{unused.getsockname()[1]}"


def environments(count: int, devices: int = 1) -> Iterator[dict[str, str]]:
    """Yield the environment of each of `count` processes, with `devices` CPU devices each."""
    common = {**os.environ, "XLA_FLAGS": xla.flags(devices), "JAX_PLATFORMS": "cpu"}
    address = free_address()
    for number in range(count):
        own = zip(NAMES, (address, str(count), str(number)), strict=True) if count > 1 else ()
        yield common | dict(own)


def start(
    count: int,
    *arguments: Any,
    own: Mapping[int, Sequence[Any]] = MappingProxyType({}),
    devices: int = 1,
    **options: Any,
) -> list[subprocess.Popen]:
    """Start `count` processes `python ARGUMENTS` of one run.

    Args:
        count: number of processes.
        arguments: arguments of every process.
        own: additional arguments by process number.
        devices: CPU devices per process.
        options: options of `Popen`.
    """
    return [
        subprocess.Popen(
            [sys.executable, *map(str, [*arguments, *own.get(number, ())])],
            **{"env": environment, "cwd": ROOT, "text": True, **options},
        )
        for number, environment in enumerate(environments(count, devices))
    ]
