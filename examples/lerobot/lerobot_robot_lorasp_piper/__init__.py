"""The PiPER as a robot of LeRobot, real (`lorasp_piper`) or simulated (`lorasp_fake_piper`).

The teleoperator `lorasp_expert` demonstrates the simulated tasks. States and actions are the joint
angles [rad] and the gripper's opening [m]. README.md in the folder above has the commands.
"""
# pyright: reportMissingImports=false
# LeRobot has an environment of its own.

import contextlib
import logging
import threading
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from lerobot.cameras import CameraConfig, make_cameras_from_configs
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.utils.decorators import check_if_not_connected

from lerobot_robot_lorasp_piper.follower import Follower
from lorasp_jax.extras.piper.arm import PiperArm
from lorasp_jax.extras.piper.arms import Arms, dimension_names
from lorasp_jax.extras.piper.clock import RealClock
from lorasp_jax.extras.piper.fake.demonstrator import Demonstrator
from lorasp_jax.extras.piper.fake.firmware import FakePiper
from lorasp_jax.extras.piper.fake.timing import Lockstep
from lorasp_jax.extras.piper.fake.world import World
from lorasp_jax.extras.piper.safety import Limits

JOINTS = tuple(dimension_names([""]))  # joint_1.pos to gripper.pos, as in exported datasets
_scene: "LoraspFakePiper | None" = None  # the fake arm of this process, which the expert plans for


@RobotConfig.register_subclass("lorasp_piper")
@dataclass(kw_only=True)
class LoraspPiperConfig(RobotConfig):
    """A PiPER on a CAN bus; `fps` is the recorder's, `speed` the highest joint speed [rad/s]."""

    can: str = "can0"
    fps: int = 10
    speed: float = 1.0
    cameras: dict[str, CameraConfig] = field(default_factory=dict)


@RobotConfig.register_subclass("lorasp_fake_piper")
@dataclass(kw_only=True)
class LoraspFakePiperConfig(RobotConfig):
    """A PiPER in the layout `seed` of a simulated task, with pictures of `image_size` pixels."""

    task: str = "press"
    seed: int = 0
    image_size: int = 64


@TeleoperatorConfig.register_subclass("lorasp_expert")
@dataclass(kw_only=True)
class LoraspExpertConfig(TeleoperatorConfig):
    """The scripted expert, for a fake PiPER in the same process."""


class LoraspPiper(Robot):
    """A real PiPER, commanded 200 times a second by a thread of its own."""

    config_class: Any = LoraspPiperConfig
    name = "piper"  # the robot of the recording, as the policies trained on it have it

    def __init__(self, config: Any) -> None:
        """Prepare; nothing moves before `connect`."""
        super().__init__(config)
        self.config, self.limits = config, Limits.of(speed=getattr(config, "speed", 1.0))
        self._follower: Follower | None = None
        self._closing = contextlib.ExitStack()
        self.cameras: dict[str, Any] = make_cameras_from_configs(getattr(config, "cameras", {}))

    @property
    def observation_features(self) -> dict[str, Any]:
        """Return joint -> float, and camera -> shape."""
        shapes = {name: (x.height, x.width, 3) for name, x in self.config.cameras.items()}
        return self.action_features | shapes

    @property
    def action_features(self) -> dict[str, type]:
        """Return joint -> float."""
        return dict.fromkeys(JOINTS, float)

    @property
    def is_calibrated(self) -> bool:
        """Return True: the firmware knows its zeros."""
        return True

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing."""

    @property
    def is_connected(self) -> bool:
        """Whether the arm follows."""
        return self._follower is not None

    def connect(self, calibrate: bool = True) -> None:  # noqa: ARG002
        """Connect, and take control where the arm is."""
        with contextlib.ExitStack() as stack:
            for camera in self.cameras.values():
                camera.connect()
                stack.callback(camera.disconnect)
            config, clock = self.config, RealClock()
            arm = PiperArm(config.can, speed=config.speed, clock=clock)
            stack.callback(arm.close)
            self._follower = follower = self._take(arm, clock, 1 / config.fps)
            thread = threading.Thread(target=follower.run, daemon=True)
            thread.start()
            for step in (follower.settle, thread.join, follower.stop):  # the last comes first
                stack.callback(step)
            self._closing = stack.pop_all()

    def _take(self, arm: PiperArm, clock: Any, control_dt: float) -> Follower:
        arms = Arms({"": arm}, self.limits)
        arms.connect()
        arms.enable()
        return Follower(arms, clock, control_dt)

    @check_if_not_connected
    def get_observation(self) -> dict[str, Any]:
        """Return the measured pose and the pictures; raise Unsafe after a problem."""
        assert self._follower
        pose = dict(zip(JOINTS, self._follower.pose().tolist(), strict=True))
        return pose | self._pictures()

    def _pictures(self) -> dict[str, np.ndarray]:
        return {name: camera.read_latest() for name, camera in self.cameras.items()}

    @check_if_not_connected
    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Begin to move; return the action within the limits."""
        assert self._follower
        target = self._follower.follow(np.array([float(action[name]) for name in JOINTS]))
        return dict(zip(JOINTS, target.tolist(), strict=True))

    @check_if_not_connected
    def disconnect(self) -> None:
        """Brake, and leave the arm holding; it is not switched off, as it would fall."""
        self._follower = None
        self._closing.close()


class LoraspFakePiper(LoraspPiper):
    """A PiPER in MuJoCo, whose time stands still except for a control step per action."""

    config_class = LoraspFakePiperConfig

    def __init__(self, config: LoraspFakePiperConfig) -> None:
        """Prepare the scene, which the expert may look at before the arm is connected."""
        global _scene  # noqa: PLW0603
        super().__init__(config)
        self.world = World(config.task, image_size=config.image_size)
        self.world.reset(config.seed)
        self.cameras = dict.fromkeys(self.world.images())
        self.fake = FakePiper("lerobot", self.world, seed=config.seed)
        self.clock = Lockstep(self.fake)
        _scene = self

    @property
    def observation_features(self) -> dict[str, Any]:
        """Return joint -> float, and camera -> shape."""
        size = self.config.image_size
        return self.action_features | dict.fromkeys(self.cameras, (size, size, 3))

    def connect(self, calibrate: bool = True) -> None:  # noqa: ARG002
        """Take control of the simulated arm."""
        arm = PiperArm("lerobot", bus="virtual", clock=self.clock)
        self.clock.start(arm)
        self._follower = self._take(arm, self.clock, self.world.env.control_dt)
        for step in (self.fake.close, arm.close):
            self._closing.callback(step)

    def _pictures(self) -> dict[str, np.ndarray]:
        return self.world.images()

    @check_if_not_connected
    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Move for a control step; return the action within the limits."""
        sent = super().send_action(action)
        assert self._follower
        self._follower.run(self.world.env.control_dt)
        self.world.judge()
        return sent

    def disconnect(self) -> None:
        """Say whether the task is solved."""
        super().disconnect()
        success = "is" if self.world.success else "is not"
        logging.info("%s in layout %d %s solved", self.config.task, self.config.seed, success)


class LoraspExpert(Teleoperator):
    """Demonstrates a task once."""

    config_class, name = LoraspExpertConfig, "lorasp_expert"

    def __init__(self, config: LoraspExpertConfig) -> None:
        """Prepare."""
        super().__init__(config)
        self._expert: Demonstrator | None = None

    action_features = LoraspPiper.action_features
    is_calibrated, calibrate = LoraspPiper.is_calibrated, LoraspPiper.calibrate
    configure = LoraspPiper.configure

    @property
    def feedback_features(self) -> dict[str, type]:
        """Return none."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether there is a plan."""
        return self._expert is not None

    def connect(self, calibrate: bool = True) -> None:  # noqa: ARG002
        """Plan for the fake arm's layout.

        Raises:
            ConnectionError: there is none in this process.
        """
        if _scene is None:
            raise ConnectionError("the expert knows the way of --robot.type=lorasp_fake_piper only")
        self._expert = Demonstrator(_scene.world, _scene.clock, _scene.config.seed)

    @check_if_not_connected
    def get_action(self) -> dict[str, Any]:
        """Return the expert's action now; after its last one it stands still."""
        assert self._expert
        return dict(zip(JOINTS, self._expert({})[0].tolist(), strict=True))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing."""

    def disconnect(self) -> None:
        """Forget the plan."""
        self._expert = None
