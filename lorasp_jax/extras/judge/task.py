"""Tasks of Gymnasium environments: what a policy sees of them, and how its actions act."""

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Images = dict[str, np.ndarray]
"""Camera of the policy -> uint8 `[H, W, 3]`."""


@dataclass(frozen=True)
class GymTask:
    """One task of an environment, and the mapping between the environment and a policy.

    Attributes:
        name: name in the results.
        instruction: sentence for the policy.
        make: creates the environment: `reset(seed=)`, `step`, `close` and `action_space` as in
            Gymnasium.
        cameras: camera of the policy -> key of the observation, or a function from the environment
            to a picture, uint8 `[H, W, 3]`. A function is called only when the policy looks.
        state: key of the observation, or a function from the observation to the state `[D]`, in the
            units of the training data.
        action: maps one action of the policy, f32 `[A]`, to an action of the environment.
        success: key of `info`; an episode succeeds as soon as its value is true.
        hold: environment steps per action of the policy: the ratio of control periods.
        replan: actions executed of each chunk before the policy looks again.
        max_steps: environment steps after which an episode ends if the environment does not end it.
        group: group in the results, such as a degree of difficulty.
    """

    name: str
    instruction: str
    make: Callable[[], Any]
    cameras: Mapping[str, str | Callable[[Any], np.ndarray]]
    state: str | Callable[[Any], np.ndarray]
    action: Callable[[np.ndarray], Any] = np.asarray
    success: str = "success"
    hold: int = 1
    replan: int = 5
    max_steps: int = 500
    group: str = ""

    def __post_init__(self) -> None:
        """Validate the fields.

        Raises:
            ValueError: no instruction, no camera, or a number below 1.
        """
        if not self.instruction or not self.cameras:
            raise ValueError(f"task {self.name} needs an instruction and at least one camera")
        for field in ("hold", "replan", "max_steps"):
            if (value := getattr(self, field)) < 1:
                raise ValueError(f"{field} of task {self.name} must be at least 1, got {value}")

    def images(self, env: Any, observation: Any) -> Images:
        """Return what the policy's cameras see.

        Raises:
            ValueError: the observation lacks a picture, or a picture has the wrong type or shape.
        """
        pictures = {}
        for name, source in self.cameras.items():
            picture = np.asarray(
                _entry(observation, source) if isinstance(source, str) else source(env)
            )
            if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
                raise ValueError(
                    f"camera {name} of task {self.name} must return uint8 pictures [H, W, 3], got "
                    f"{picture.dtype} {list(picture.shape)}"
                )
            pictures[name] = picture
        return pictures

    def read_state(self, observation: Any) -> np.ndarray:
        """Return the state, f32 `[D]`.

        Raises:
            ValueError: the observation lacks it, or it is not a vector.
        """
        source = self.state
        value = _entry(observation, source) if isinstance(source, str) else source(observation)
        state = np.asarray(value, np.float32)
        if state.ndim != 1:
            raise ValueError(
                f"the state of task {self.name} must have one axis, got shape {list(state.shape)}"
            )
        return state

    def command(self, env: Any, action: np.ndarray) -> Any:
        """Map an action of the policy to one of the environment.

        Raises:
            ValueError: the environment takes actions of another shape.
        """
        command = self.action(action)
        expected = getattr(getattr(env, "action_space", None), "shape", None)
        if expected is not None and np.shape(command) != tuple(expected):
            raise ValueError(
                f"the environment of task {self.name} takes actions of shape {list(expected)}, but "
                f"the policy's have shape {list(np.shape(command))}: set the task's action"
            )
        return command


def load_tasks(name: str, only: Sequence[str] = ()) -> tuple[GymTask, ...]:
    """Call a factory and return its tasks.

    Args:
        name: MODULE:factory, importable from the working directory. The factory takes no arguments
            and returns a `GymTask` or several.
        only: names of the tasks to return; empty: all.

    Raises:
        ValueError: there is no such module, factory or task, or the factory returns something else.
    """
    made = _factory(name)()
    tasks = (made,) if isinstance(made, GymTask) else made
    if not isinstance(tasks, Sequence) or not all(isinstance(each, GymTask) for each in tasks):
        raise ValueError(f"{name} must return a GymTask or a sequence of them, got {made!r:.80}")
    by_name = {task.name: task for task in tasks}
    if len(by_name) < len(tasks) or not tasks:
        raise ValueError(f"{name} must return at least one task, each with a name of its own")
    if unknown := [each for each in only if each not in by_name]:
        raise ValueError(f"{name} has no task {unknown[0]}: choose from {', '.join(by_name)}")
    return tuple(by_name[each] for each in dict.fromkeys(only)) if only else tuple(tasks)


def _factory(name: str) -> Callable[[], Any]:
    module, _, attribute = name.partition(":")
    if not module or not attribute:
        raise ValueError(f"--env must be MODULE:factory, got {name!r}")
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except ModuleNotFoundError as error:
        missing = error.name or ""
        if f"{module}.".startswith(f"{missing}."):
            raise ValueError(
                f"there is no module {module}: run the command where it can be imported from"
            ) from error
        raise ValueError(
            f"{module} needs the package {missing}, which is not installed here"
        ) from error
    if not callable(found):
        raise ValueError(f"module {module} has no function {attribute}")
    return found


def _entry(observation: Any, key: Any) -> Any:
    """Return an entry of an observation that is a map."""
    if not isinstance(observation, Mapping):
        raise ValueError(
            f"the observation has no {key}, as it is a {type(observation).__name__}, not a map"
        )
    if key not in observation:
        available = ", ".join(map(str, observation))
        raise ValueError(f"the observation has no {key}: it has {available}")
    return observation[key]
