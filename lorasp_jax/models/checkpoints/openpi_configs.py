"""openpi's named training configs: what the files of its checkpoints do not say.

A checkpoint of openpi has weights and statistics. Chunk length, relative actions, prompts, cameras,
and lengths of states and actions are in the training config that its server is given by name
(training/config.py, training/misc/polaris_config.py, policies/*_policy.py at 15a9616a):

    named = openpi_configs.find("pi05_libero")
    model = models.load("gs://openpi-assets/checkpoints/pi05_libero", named.config)

`extras.serving.loading.load_checkpoint` makes the whole policy; a `Processor.of` of one's own takes
the lengths and cameras of `named.robot`.

The configs of pi0-FAST, whose models are autoregressive, are not here, nor those of debugging.
"""

import dataclasses
import os
import sys
from dataclasses import dataclass
from typing import Any

from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.inputs import OPENPI, OPENPI_PI05
from lorasp_jax.models.pi0.pi0 import Pi0Config

TOKENIZER = "gs://big_vision/paligemma_tokenizer.model"
"""The tokenizer of all configs (models/tokenizer.py)."""


@dataclass(frozen=True)
class OpenPiRobot:
    """A robot as openpi's servers know it.

    Attributes:
        dataset: whose statistics a checkpoint with several has for it.
        cameras: the robot's names for the backbone's cameras, in order; further ones are missing.
        state_dim: length of states.
        action_length: length of actions.
        relative: mask of the actions that configs with relative actions make relative.
        aloha: see `InputConfig.aloha`.
    """

    dataset: str
    cameras: tuple[str, ...]
    state_dim: int
    action_length: int
    relative: tuple[bool, ...]
    aloha: bool = False


_ARM = (*[True] * 6, False)
LIBERO = OpenPiRobot("physical-intelligence/libero", ("image", "wrist_image"), 8, 7, _ARM)
DROID = OpenPiRobot(
    "droid", ("exterior_image_1_left", "wrist_image_left"), 8, 8, (*[True] * 7, False)
)
ALOHA = OpenPiRobot(
    "trossen", ("cam_high", "cam_left_wrist", "cam_right_wrist"), 14, 14, _ARM * 2, aloha=True
)
_POSE = (0.0, -1.5, 1.5, 0.0, 0.0, 0.0)
ALOHA_SIM = dataclasses.replace(ALOHA, dataset="lerobot/aloha_sim_transfer_cube_human")


@dataclass(frozen=True)
class OpenPiConfig:
    """A named training config.

    Attributes:
        robot: its robot.
        pi05: whether the model is pi0.5.
        chunk: actions per chunk.
        relative: whether actions are relative to the state; see `OpenPiRobot.relative`.
        prompt: instruction of requests that have none; "": they must have one.
        prompt_state: whether prompts of pi0.5 contain the state.
        max_tokens: length of the padded prompt; None: the model's default.
        reset_pose: joints of each arm [rad] that the server tells its clients to start from.
    """

    robot: OpenPiRobot
    pi05: bool = False
    chunk: int = 50
    relative: bool = False
    prompt: str = ""
    prompt_state: bool = True
    max_tokens: int | None = None
    reset_pose: tuple[float, ...] = ()

    def __str__(self) -> str:
        prompts = f", prompts {'with' if self.prompt_state else 'without'} the state" * self.pi05
        units = ", units of ALOHA" * self.robot.aloha
        actions = "relative" if self.relative else "absolute"
        return f"chunks of {self.chunk} {actions} actions{prompts}{units}"

    @property
    def config(self) -> Pi0Config:
        """The config of the published size."""
        return self.apply(Pi0Config.base_pi05() if self.pi05 else Pi0Config.base())

    def apply(self, config: Any) -> Any:
        """Return a config of any size of pi0 or pi0.5 with what this one says.

        Raises:
            ValueError: `config` is of the other model.
        """
        if getattr(config, "pi05", None) != self.pi05:
            raise ValueError(
                f"this training config is of {'pi0.5' if self.pi05 else 'pi0'}: choose such a "
                f"size, as {'base_pi05' if self.pi05 else 'base'}"
            )
        inputs = dataclasses.replace(
            OPENPI_PI05 if self.pi05 else OPENPI,
            delta=self.robot.relative if self.relative else (),
            aloha=self.robot.aloha,
            prompt_state=self.pi05 and self.prompt_state,
        )
        tokens = self.max_tokens or config.max_tokens
        return dataclasses.replace(config, chunk=self.chunk, max_tokens=tokens, inputs=inputs)

    def cameras(self, config: BackboneConfig) -> dict[str, str]:
        """Return the backbone's cameras and the robot's names for them."""
        return dict(zip(config.cameras, self.robot.cameras, strict=False))


CONFIGS: dict[str, OpenPiConfig] = {
    "pi0_aloha": OpenPiConfig(ALOHA, relative=True, reset_pose=_POSE),
    "pi05_aloha": OpenPiConfig(ALOHA, pi05=True, relative=True, reset_pose=_POSE),
    "pi0_aloha_towel": OpenPiConfig(
        ALOHA, relative=True, prompt="fold the towel", reset_pose=_POSE
    ),
    "pi0_aloha_tupperware": OpenPiConfig(
        ALOHA,
        relative=True,
        prompt="open the tupperware and put the food on the plate",
        reset_pose=_POSE,
    ),
    "pi0_aloha_pen_uncap": OpenPiConfig(ALOHA, relative=True, prompt="uncap the pen"),
    "pi05_aloha_pen_uncap": OpenPiConfig(ALOHA, pi05=True, relative=True, prompt="uncap the pen"),
    "pi0_aloha_sim": OpenPiConfig(ALOHA_SIM, prompt="Transfer cube"),
    "pi0_droid": OpenPiConfig(DROID, chunk=10),
    "pi05_droid": OpenPiConfig(DROID, pi05=True, chunk=15),
    "pi05_droid_finetune": OpenPiConfig(DROID, pi05=True, chunk=16),
    "pi05_full_droid_finetune": OpenPiConfig(DROID, pi05=True, chunk=16, relative=True),
    "pi05_droid_jointpos_polaris": OpenPiConfig(DROID, pi05=True, chunk=15, relative=True),
    "pi0_droid_jointpos_polaris": OpenPiConfig(DROID, chunk=10, relative=True, max_tokens=100),
    "pi0_droid_jointpos_100k_polaris": OpenPiConfig(DROID, chunk=10, relative=True, max_tokens=100),
    "pi0_libero": OpenPiConfig(LIBERO, relative=True),
    "pi0_libero_low_mem_finetune": OpenPiConfig(LIBERO, relative=True),
    "pi05_libero": OpenPiConfig(LIBERO, pi05=True, chunk=10, prompt_state=False),
}


def find(name: str) -> OpenPiConfig:
    """Return a training config by name; raise ValueError if there is none."""
    if name not in CONFIGS:
        raise ValueError(
            f"unknown training config {name!r} of openpi: choose one of {', '.join(CONFIGS)}"
        )
    return CONFIGS[name]


def guess(where: str | os.PathLike[str]) -> OpenPiConfig | None:
    """Return the training config that a folder of this path is named after, and print a line.

    openpi's training writes checkpoints/CONFIG/EXPERIMENT/STEP. None if no part is such a name.
    """
    parts = os.fspath(where).split("/")
    name = next((part for part in reversed(parts) if part in CONFIGS), None)
    if name is None:
        return None
    print(
        f"taking {where} for a checkpoint of openpi's training config {name}, after its name: "
        f"{CONFIGS[name]}",
        file=sys.stderr,
    )
    return CONFIGS[name]
