"""What every kind of dataset gives."""

from collections.abc import Callable, Collection, Sequence
from typing import Protocol

from envs.datasets.episodes import Episodes

Progress = Callable[[int, int], None]
"""Called with steps done and steps in all."""


class Source(Protocol):
    """Episodes that are read one by one."""

    @property
    def kind(self) -> str:
        """The format."""
        ...

    @property
    def cameras(self) -> Collection[str]:
        """Names."""
        ...

    @property
    def control_dt(self) -> float:
        """Time between two actions [s]."""
        ...

    @property
    def num_steps(self) -> int:
        """Control steps of all episodes."""
        ...

    def __len__(self) -> int:
        """Number of episodes."""
        ...

    def episode(self, number: int, cameras: Sequence[str] | None = None) -> Episodes:
        """One episode in host memory, with the pictures of these cameras; None: all."""
        ...
