"""Several processes of one run, on this machine."""

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
    """An address on this machine where nobody listens."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{free.getsockname()[1]}"


def environments(count: int, devices: int = 1) -> Iterator[dict[str, str]]:
    """Of each of `count` processes that are to find one another, with so many CPU devices each."""
    everyone = {**os.environ, "XLA_FLAGS": xla.flags(devices), "JAX_PLATFORMS": "cpu"}
    address = free_address()
    for number in range(count):
        own = zip(NAMES, (address, str(count), str(number)), strict=True) if count > 1 else ()
        yield everyone | dict(own)


def start(
    count: int,
    *arguments: Any,
    own: Mapping[int, Sequence[Any]] = MappingProxyType({}),
    devices: int = 1,
    **options: Any,
) -> list[subprocess.Popen]:
    """`count` processes `python ARGUMENTS`, which find one another.

    Args:
        arguments: of all.
        own: further ones, by a process's number.
        devices: of each.
        options: of `Popen`.
    """
    return [
        subprocess.Popen(
            [sys.executable, *map(str, [*arguments, *own.get(number, ())])],
            **{"env": environment, "cwd": ROOT, "text": True, **options},
        )
        for number, environment in enumerate(environments(count, devices))
    ]
