"""Meta-World's environments with seeds and pictures, and the tasks for `lorasp_jax judge`.

    lorasp-jax judge --server ws://127.0.0.1:8000 --env studies.metaworld.world:mt50

The package itself is unmodified: its physics, its scenes and its success. As in LeRobot's protocol
(src/lerobot/envs/metaworld.py), a policy sees the camera corner2, moved and turned upside down, and
the first four numbers of the observation: hand position [m] and gripper opening.
"""

import functools
from typing import Any

import numpy as np

from lorasp_jax.extras.judge import GymTask
from studies.metaworld.tasks import GROUPS, INSTALL

try:
    import gymnasium
    import metaworld.env_dict as tables  # pyright: ignore[reportMissingImports]
    import mujoco
except ModuleNotFoundError as error:
    raise ValueError(f"Meta-World's tasks need {error.name}: {INSTALL}") from error

CAMERA = "corner2"
CAMERA_POSITION = (0.75, 0.075, 0.7)
"""Place of the camera [m], LeRobot's."""
IMAGE_SIZE = 128
"""Height and width of pictures [pixels]."""
HOLD = 8
"""Environment steps of 12.5 ms per action: policies act at 10 Hz, as this project's bases do."""
REPLAN = 5
"""Actions that a policy executes before it looks again."""
STATE_DIM = 4


class World(gymnasium.Env):
    """One task of Meta-World, whose layout depends on the seed of `reset`."""

    def __init__(self, name: str) -> None:
        """Make the environment, such as "reach", with the camera in place and without shadows."""
        self.inner: Any = tables.ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{name}-v3-goal-observable"](
            seed=0
        )
        self.inner._freeze_rand_vec = False  # a new layout at every reset
        self.inner.seeded_rand_vec = True  # from the seed, not from NumPy's global generator
        self.metadata = self.inner.metadata
        self.action_space = self.inner.action_space
        self.observation_space = self.inner.observation_space
        model = self.inner.model
        model.cam_pos[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, CAMERA)] = (
            CAMERA_POSITION
        )
        model.light_castshadow[:] = 0  # six times faster with software rendering
        self._renderer: Any = None

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, Any]:
        """Start an episode; Meta-World takes its seed elsewhere."""
        if seed is not None:
            self.inner.seed(seed)
        return self.inner.reset(options=options)

    def step(self, action: Any) -> Any:
        """Run the environment for 12.5 ms."""
        return self.inner.step(action)

    def picture(self, moment: Any = None) -> np.ndarray:
        """Render the camera, uint8 `[IMAGE_SIZE, IMAGE_SIZE, 3]`.

        Args:
            moment: `mujoco.MjData`, such as a copy of `inner.data`; none: the present.
        """
        if self._renderer is None:
            self._renderer = mujoco.Renderer(self.inner.model, IMAGE_SIZE, IMAGE_SIZE)
            # MuJoCo would draw a reflection, which changes no picture of the fifty tasks.
            self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._renderer.update_scene(self.inner.data if moment is None else moment, camera=CAMERA)
        return np.ascontiguousarray(self._renderer.render()[::-1, ::-1])

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self.inner.close()


def state(observation: np.ndarray) -> np.ndarray:
    """Return hand position [m] and gripper opening, 0 closed to 1 open."""
    return observation[:STATE_DIM]


def mt50() -> list[GymTask]:
    """Return all fifty tasks, with the package's own limit of 500 steps."""
    return [
        GymTask(
            name=name,
            instruction=instruction,
            make=functools.partial(World, name),
            cameras={CAMERA: World.picture},
            state=state,
            action=lambda action: np.clip(action, -1, 1),
            hold=HOLD,
            replan=REPLAN,
            group=group,
        )
        for group, tasks in GROUPS.items()
        for name, instruction in tasks.items()
    ]
