"""What a backbone's weights were trained to see: pictures, numbers, slots."""

import dataclasses
from dataclasses import dataclass
from typing import Literal

Mode = Literal["mean_std", "min_max", "quantiles", "quantile10", "identity"]
Convention = Literal["ours", "openpi", "lerobot"]


@dataclass(frozen=True)
class InputConfig:
    """How raw observations and actions become a backbone's; a field of its config."""

    centred: bool = True
    """A picture of another aspect has black bars on both sides; False: one, left or above."""
    antialias: bool = True
    """Pictures are smoothed before they are shrunk."""
    state: Mode = "mean_std"
    """How states are normalised, see `normalization`."""
    action: Mode = "mean_std"
    """How actions are."""
    delta: tuple[bool, ...] = ()
    """Which actions are relative to the state that a chunk starts from, see `processing.to_delta`;
    the robot's statistics are then those of such actions."""
    convention: Convention = "ours"
    """Whose way to avoid a division by zero."""
    gripper_slot: int | None = 7
    """Slot of the gripper in state and action vectors; None: the next one after the joints'."""
    quiet_slots: bool = True
    """Slots that a robot does not use stay zero in the flow; False: they carry noise and count in
    the loss, with zero as their value, as other slots do."""
    prompt_state: bool = False
    """The prompt tells the robot's normalised numbers, see `prompts.pi05`."""
    masks_missing: bool = True
    """A missing camera's picture is black and masked; False: it has no place at all."""


OURS = InputConfig()
"""This project's own weights."""
OPENPI = InputConfig(convention="openpi", gripper_slot=None, quiet_slots=False)
"""pi0 in openpi (shared/image_tools.py, transforms.py at 15a9616a)."""
_PI05 = {"state": "quantiles", "action": "quantiles", "prompt_state": True}
OURS_PI05, OPENPI_PI05 = (dataclasses.replace(inputs, **_PI05) for inputs in (OURS, OPENPI))
"""pi0.5, ours and in openpi (training/config.py, use_quantile_norm, ModelTransformFactory)."""
LEROBOT_CENTRED = dataclasses.replace(OPENPI, antialias=False, convention="lerobot")
"""pi0 in LeRobot 0.6 (policies/common/vla_utils.py, processor/normalize_processor.py)."""
LEROBOT_PI05 = dataclasses.replace(LEROBOT_CENTRED, **_PI05)
"""pi0.5 in LeRobot 0.6 (policies/pi05/processor_pi05.py, configuration_pi05.py)."""
LEROBOT = dataclasses.replace(LEROBOT_CENTRED, centred=False, masks_missing=False)
"""SmolVLA in LeRobot 0.6 (policies/smolvla/modeling_smolvla.py)."""
