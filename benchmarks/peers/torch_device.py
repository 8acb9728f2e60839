"""What the programs in PyTorch share: device, waiting, memory."""

from typing import Any

import torch  # pyright: ignore[reportMissingImports]

from benchmarks.peers.worker import GIB


def device() -> str:
    """Return the device to use."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def name() -> str:
    """Name the device; "cpu" as JAX calls it."""
    return torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu"


def wait(_: Any = None) -> None:
    """Wait until the device has finished."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def peak_gib() -> float | None:
    """Return the most device memory allocated in this process [GiB]; None on a CPU."""
    return torch.cuda.max_memory_allocated() / GIB if torch.cuda.is_available() else None


def autocast(enabled: bool) -> torch.autocast:
    """Return a context in which matrix products run in bf16."""
    return torch.autocast(device(), torch.bfloat16, enabled=enabled)
