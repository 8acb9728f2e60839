"""Record episodes of a real or fake arm as an RLDS dataset, which `--data.source` takes."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from envs.datasets.episodes import Episodes
from envs.datasets.rlds import ShardWriter
from lorasp_jax.extras.serving.pictures import to_square

_REAL = 0.0  # physics_dt of recordings of real robots, as `Episodes` has it


class Recording:
    """A dataset that grows by one episode at a time, also over several runs of a program.

    Use it under `lorasp_jax.base.locks.locked`.

    Attributes:
        steps: control steps of the present episode.
        marks: whether corrections can be marked, as older datasets cannot.
    """

    def __init__(
        self,
        folder: Path,
        *,
        task: str,
        instructions: Sequence[str],
        prompt: str,
        control_dt: float,
        robot: str = "piper",
        names: Sequence[str] = (),
        image_size: int = 224,
        physics_dt: float = _REAL,
    ) -> None:
        """Open or create a dataset.

        Args:
            folder: of the dataset; an existing one goes on, and must have the same settings.
            task: its name; "": that of the existing dataset, or "task".
            instructions: phrasings of the task.
            prompt: the phrasing of the present episode; added to the others if it is new.
            control_dt: duration of an action [s].
            robot: its name.
            names: of the dimensions of poses; empty: those of one arm.
            image_size: height and width of the stored pictures [px], padded with black.
            physics_dt: period of the simulation [s].

        Raises:
            ValueError: the folder holds something else, or a dataset with other settings.
        """
        named = {"names": [*names]} if names else {}
        self._writer = ShardWriter(folder, {"image_size": image_size, **named})
        earlier = self._writer.metadata
        self.marks: bool = earlier.get("corrected", not earlier["parts"])
        self._shared = {"task": task or earlier.get("task", "task"), "robot": robot}
        self._shared |= {"control_dt": control_dt, "physics_dt": physics_dt}
        for name, value in self._shared.items():  # before somebody demonstrates in vain
            if (was := earlier.get(name, value)) != value:
                raise ValueError(f"{folder} has {name} {was}, not {value}: choose another folder")
        known = [*earlier.get("instructions", []), *instructions]
        self._shared["instructions"] = tuple(dict.fromkeys(known))
        self._image_size, self._failures = image_size, 0
        self.say(prompt)
        self.discard()

    @property
    def num_episodes(self) -> int:
        """Number of episodes in the dataset."""
        return self._writer.num_episodes

    @property
    def steps(self) -> int:
        """Number of control steps of the present episode."""
        return len(self._actions)

    def step(
        self,
        images: Mapping[str, np.ndarray],
        state: np.ndarray,
        action: np.ndarray,
        *,
        corrected: bool = False,
    ) -> None:
        """Add a control step: pictures uint8 [H, W, 3], measured pose and action [7 N].

        `corrected` says that a person acted in place of a policy.
        """
        for name, image in images.items():
            square = to_square(name, image, self._image_size)
            self._images.setdefault(name, []).append(square)
        self._states.append(state)
        self._actions.append(action)
        self._corrected.append(corrected)

    def say(self, prompt: str) -> None:
        """Set the phrasing of the present episode, which is added to the dataset's if it is new."""
        self._prompt = prompt
        if prompt not in self._shared["instructions"]:
            self._shared["instructions"] += (prompt,)

    def fail(self) -> None:
        """Forget the present episode, and count it as an attempt with the next one that is kept."""
        self._failures += 1
        self.discard()

    def discard(self) -> None:
        """Forget the present episode."""
        self._images: dict[str, list[np.ndarray]] = {}
        self._states: list[np.ndarray] = []
        self._actions: list[np.ndarray] = []
        self._corrected: list[bool] = []

    def keep(self, success: bool | None = None) -> None:
        """Write the present episode, and complete the dataset.

        Args:
            success: its outcome; None: nobody said.

        Raises:
            ValueError: the episode is empty, or differs from the dataset's in cameras.
            OSError: the disk is full; earlier episodes are unaffected.
        """
        if not self.steps:
            raise ValueError("there is nothing to record: the episode has no step")
        instructions = self._shared["instructions"]
        episode = Episodes(
            image={name: np.stack(images)[None] for name, images in self._images.items()},
            state=np.stack(self._states)[None].astype(np.float32),
            action=np.stack(self._actions)[None].astype(np.float32),
            length=np.array([self.steps], np.int32),
            instruction=np.array([instructions.index(self._prompt)], np.int32),
            success=np.array([-1 if success is None else success], np.int32),
            corrected=np.array([self._corrected]),
            attempted=1 + self._failures,
            **self._shared,
        )
        self._writer.append(episode)
        self._writer.complete()
        self._failures = 0
        self.discard()
