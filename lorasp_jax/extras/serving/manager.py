"""Tell the service manager, such as systemd, how the server is: sd_notify(3), in a few lines."""

import asyncio
import os
import socket
from collections.abc import Callable


def notify(state: str) -> None:
    """Send a state such as READY=1 to the manager that started this process, if there is one.

    Raises:
        OSError: the manager's socket, which NOTIFY_SOCKET names, is gone.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if address:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
            # A leading @ stands for Linux's abstract names.
            manager.sendto(state.encode(), f"\0{address[1:]}" if address[0] == "@" else address)


async def watch(problem: Callable[[], str | None]) -> None:
    """Reassure the manager as often as it asked (WATCHDOG_USEC) while there is no problem.

    A manager that hears nothing for that long restarts the process.
    """
    period = int(os.environ.get("WATCHDOG_USEC", "0")) / 1e6
    while period:
        reason = problem()
        notify(f"STATUS={reason}" if reason else "WATCHDOG=1\nSTATUS=serving")
        await asyncio.sleep(period / 2)
