"""The interface that all dataset formats share."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from envs.datasets.episodes import Episodes

Progress = Callable[[int, int], None]
"""Called with the steps done and the total."""

_DT_TOLERANCE = 0.01  # relative; 1/30 s has no exact decimal representation


class Source(Protocol):
    """A dataset whose episodes are loaded one at a time."""

    @property
    def kind(self) -> str:
        """Name of the format."""
        ...

    @property
    def cameras(self) -> Collection[str]:
        """Names of the cameras."""
        ...

    @property
    def left_out(self) -> Mapping[str, str]:
        """Camera or other picture -> why it is not among the cameras."""
        ...

    @property
    def control_dt(self) -> float:
        """Time between two actions [s]."""
        ...

    @property
    def num_steps(self) -> int:
        """Total number of control steps."""
        ...

    def __len__(self) -> int:
        """Number of episodes."""
        ...

    def episode(self, number: int, cameras: Sequence[str] | None = None) -> Episodes:
        """Load one episode into host memory, with images from `cameras`, or from all if None."""
        ...


def dimension_names(source: Source) -> dict[str, list[str]]:
    """Return the names of the dimensions of "state" and "action", as the recordings have them.

    Empty if they have none.
    """
    names: dict[str, list[str]] = getattr(source, "names", {})
    named = not all(name.isdecimal() for row in names.values() for name in row)
    return names if named else {}


def grippers(source: Source, kind: str = "action") -> list[int]:
    """Return which dimensions of states or actions are grippers: the last, if nothing says so."""
    known: dict[str, list[int]] = getattr(source, "grippers", {})
    return known.get(kind) or [getattr(source.episode(0, ()), kind).shape[-1] - 1]


def hints(state: np.ndarray, of_grippers: Sequence[int]) -> list[str]:
    """Return hints about probable unit errors in states `[N, J+1]`; some numbers are grippers'."""
    is_gripper = np.isin(np.arange(state.shape[1]), of_grippers)
    joints = np.abs(state[:, ~is_gripper]).max(initial=0)
    gripper = np.abs(state[:, is_gripper]).max()
    texts = []
    if joints > 2 * math.pi:
        texts.append(
            f"joint angles reach {joints:.4g} rad; if they are in degrees, add --angles degrees"
        )
    if gripper > 1:
        texts.append(
            f"the gripper opens to {gripper:.4g} m; percent may stay, but if that is in mm, add "
            "--gripper millimetres"
        )
    return texts


def dimensions(source: Source) -> dict[str, dict[str, Any]]:
    """Return which dimensions are `grippers`, and their `names` if they have any."""
    names = dimension_names(source)
    found = {kind: grippers(source, kind) for kind in ("state", "action")} if len(source) else {}
    return {"grippers": found} | ({"names": names} if names else {})


def describe_left_out(source: Source) -> str:
    """Name the pictures that are not used, on one line; empty if all are."""
    texts = [f"{name} ({reason})" for name, reason in source.left_out.items()]
    return "left out: " * bool(texts) + ", ".join(texts)


def same_period(a: float, b: float) -> bool:
    """Whether two control periods [s] are the same."""
    return abs(a / b - 1) <= _DT_TOLERANCE
