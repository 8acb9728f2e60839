"""Several datasets as one, with the same cameras, instructions and period."""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from envs.datasets.episodes import Episodes, choose_cameras
from lorasp_jax.data.source import Source, dimension_names, grippers, same_period

Fit = Callable[[np.ndarray], np.ndarray]
"""Makes images `[T, H, W, 3]` uint8 of any size square, as the model will."""
_SAVE = "saved in a TOML file with python -m lorasp_jax.data inspect --save"


@dataclasses.dataclass(frozen=True)
class Part:
    """One of several datasets, whose episodes follow those of the part before it.

    Attributes:
        name: name of the dataset.
        episodes: number of its episodes.
        cameras: its cameras; others are black in its episodes.
    """

    name: str
    episodes: int
    cameras: tuple[str, ...]


def parts_of(source: Source) -> Sequence[Part]:
    """Return the datasets that a dataset was joined from, of which a cache may have one."""
    return getattr(source, "parts", ())


def dataset_of(source: Source) -> np.ndarray:
    """Return the index of each episode's dataset among `parts_of`, `[E]` int32."""
    counts = [part.episodes for part in parts_of(source)]
    index = np.arange(len(counts), dtype=np.int32)
    return np.repeat(index, counts) if counts[1:] else np.zeros(len(source), np.int32)


class Renamed:
    """A dataset under other names of its cameras, which is otherwise as it was."""

    def __init__(self, source: Source, cameras: Mapping[str, str]) -> None:
        """`cameras` maps each name to the dataset's own, for all of the cameras of `source`."""
        self.cameras: Mapping[str, str] = cameras
        self.kind, self.left_out, self.control_dt = source.kind, source.left_out, source.control_dt
        self.num_steps: int = source.num_steps
        self.sources: Mapping[str, Source] = {"": source}
        self.names: dict[str, list[str]] = dimension_names(source)
        self.grippers: dict[str, list[int]] = getattr(source, "grippers", {})
        self.parts: tuple[Part, ...] = tuple(
            dataclasses.replace(
                part, cameras=tuple(n for n, x in cameras.items() if x in part.cameras)
            )
            for part in parts_of(source)
        )

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.sources[""])

    def episode(self, number: int, cameras: Sequence[str] | None = None) -> Episodes:
        """Load one episode with images from `cameras`, or from all if None."""
        names = self.cameras if cameras is None else cameras
        found = self.sources[""].episode(number, [self.cameras[name] for name in names])
        images = {name: found.image[self.cameras[name]] for name in names}
        return dataclasses.replace(found, image=images)


class Joined:
    """Several datasets as one, in order.

    Robots of different names become one robot "a + b". Recordings joined with simulated episodes
    count as recordings.

    Attributes:
        kind: number of datasets.
        sources: the datasets by name.
        parts: the same for a cache.
        cameras: name -> height and width.
        left_out: picture -> why it is not among the cameras.
        control_dt: time between two actions [s].
        names: names of the dimensions, if all datasets have the same; as in `LeRobot`.
        grippers: which of them are grippers.
    """

    def __init__(
        self, sources: Mapping[str, Source], cameras: Sequence[str] = (), fit: Fit | None = None
    ) -> None:
        """Join datasets by name.

        Args:
            sources: the datasets.
            cameras: names of the cameras to use; empty: all.
            fit: for the images of a camera whose size differs between datasets; None: refuse them.

        Raises:
            ValueError: a camera is unknown, or the datasets have no camera in common or differ in
                period, image size, number of dimensions, grippers or kind of actions.
        """
        self.sources: Mapping[str, Source] = sources
        self.kind: str = f"{len(sources)} datasets"
        available = {camera: camera for each in sources.values() for camera in each.cameras}
        chosen, not_chosen = choose_cameras(available, cameras, Path(" and ".join(sources)))
        self.left_out: dict[str, str] = {
            f"{camera} of {name}": reason
            for name, each in sources.items()
            for camera, reason in {**not_chosen, **each.left_out}.items()
            if camera in {*each.cameras, *each.left_out}
        }
        for name, each in sources.items():
            if any(len(part.cameras) < len(each.cameras) for part in parts_of(each)):
                raise ValueError(
                    f"{name} holds datasets of which some lack a camera: name them in its place"
                )
        self.parts: tuple[Part, ...] = tuple(
            Part(name, len(each), tuple(camera for camera in chosen if camera in each.cameras))
            for name, each in sources.items()
        )
        self._ends = [*itertools.accumulate(part.episodes for part in self.parts)]
        self._check_cameras()
        first = {part.name: sources[part.name].episode(0, part.cameras) for part in self.parts}
        _check(first)
        self.grippers: dict[str, list[int]] = _common_grippers(sources)
        names = [dimension_names(source) for source in sources.values()]
        self.names: dict[str, list[str]] = names[0] if names == names[:1] * len(names) else {}
        self._fit, self._same = fit, _common([*first.values()])
        self.control_dt: float = self._same["control_dt"]
        self.cameras: dict[str, tuple[int, int]] = {}
        for camera in chosen:
            having = {name: e for name, e in first.items() if camera in e.image}
            self.cameras[camera] = self._size(camera, having)

    def __len__(self) -> int:
        """Number of episodes."""
        return self._ends[-1]

    @property
    def num_steps(self) -> int:
        """Total number of control steps."""
        return sum(source.num_steps for source in self.sources.values())

    def episode(self, number: int, cameras: Sequence[str] | None = None) -> Episodes:
        """Load one episode into host memory, with images from `cameras`, or from all if None."""
        index = int(np.searchsorted(self._ends, number, side="right"))
        part, names = self.parts[index], self.cameras if cameras is None else cameras
        own = [name for name in names if name in part.cameras]
        found = self.sources[part.name].episode(number - self._ends[index] + part.episodes, own)
        row = self._same["instructions"].index(found.phrases[0])
        images = {name: self._images(found, name) for name in names}
        changed = {"image": images, "instruction": np.array([row], np.int32)}
        return dataclasses.replace(found, **changed, **self._same)

    def _images(self, episode: Episodes, camera: str) -> np.ndarray:
        """Return a camera's images at its common size; a missing camera's are black."""
        size = self.cameras[camera]
        if camera not in episode.image:
            return np.broadcast_to(np.uint8(0), (*episode.state.shape[:2], *size, 3))
        images = np.asarray(episode.image[camera])
        if self._fit is None or images.shape[2:4] == size:
            return images
        return self._fit(images[0])[None]

    def _size(self, camera: str, first: Mapping[str, Episodes]) -> tuple[int, int]:
        """Return the common height and width of a camera's images."""
        sizes = {name: e.image[camera].shape[2:4] for name, e in first.items()}
        (name, size), *others = sizes.items()
        if different := [other for other in others if other[1] != size]:
            if self._fit is None:
                (other, found) = different[0]
                raise ValueError(
                    f"camera {camera} has {size[0]} x {size[1]} pixels in {name} and {found[0]} x "
                    f"{found[1]} in {other}: name both in --data.source of a run, which pads them"
                )
            size = self._fit(np.asarray(first[name].image[camera])[0, :1]).shape[1:3]
        return size[0], size[1]

    def _check_cameras(self) -> None:
        """Raise ValueError if a dataset has no camera of the first one's."""
        (a, first), *others = ((part.name, part.cameras) for part in self.parts)
        for b, cameras in others:
            if not set(first) & set(cameras):
                raise ValueError(
                    f"{a} has cameras {', '.join(self.sources[a].cameras)} and {b} "
                    f"{', '.join(self.sources[b].cameras)}: name the same ones alike with "
                    f"--cameras NAME=CAMERA, {_SAVE}"
                )


def _common_grippers(sources: Mapping[str, Source]) -> dict[str, list[int]]:
    """Return the grippers of all datasets; raise ValueError if two differ."""
    (a, one), *others = (
        (name, {kind: grippers(source, kind) for kind in ("state", "action")})
        for name, source in sources.items()
    )
    for b, other in others:
        if other != one:
            raise ValueError(
                f"the grippers are dimensions {one['action']} in {a} and {other['action']} in {b}: "
                f"name them with --grippers, {_SAVE}"
            )
    return one


def _common(first: Sequence[Episodes]) -> dict[str, Any]:
    """Return the fields that all episodes have in common, from the first one of each dataset."""
    times = {episode.physics_dt for episode in first}
    return {
        "robot": " + ".join(dict.fromkeys(episode.robot for episode in first)),
        "physics_dt": times.pop() if len(times) == 1 else 0.0,
        "control_dt": first[0].control_dt,
        "instructions": tuple(
            dict.fromkeys(text for episode in first for text in episode.instructions)
        ),
    }


def _check(first: Mapping[str, Episodes]) -> None:
    """Raise ValueError, naming two datasets, unless their first episodes can be joined."""
    (a, one), *others = first.items()
    for b, other in others:
        (states, actions), (b_states, b_actions) = (
            (episode.state.shape[-1], episode.action.shape[-1]) for episode in (one, other)
        )
        if (states, actions) != (b_states, b_actions):
            raise ValueError(
                f"states and actions have {states} and {actions} numbers in {a}, but {b_states} "
                f"and {b_actions} in {b}: select the same with --state-numbers and "
                f"--action-numbers, {_SAVE}"
            )
        if not same_period(one.control_dt, other.control_dt):
            raise ValueError(
                f"{a} has a control period of {one.control_dt:.4g} s and {b} of "
                f"{other.control_dt:.4g} s: keep every N-th step of the faster with --every N, "
                f"{_SAVE}"
            )
        if one.actions != other.actions:
            raise ValueError(f"{a} has {one.actions} actions, but {b} has {other.actions} actions")
