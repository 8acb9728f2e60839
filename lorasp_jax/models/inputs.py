"""Input preprocessing that a backbone's weights expect: images, normalization, slots."""

import dataclasses
from dataclasses import dataclass
from typing import Literal

Mode = Literal["mean_std", "min_max", "quantiles", "quantile10", "identity"]
Convention = Literal["ours", "openpi", "lerobot"]


@dataclass(frozen=True)
class InputConfig:
    """Preprocessing of raw observations and actions; a field of the backbone config."""

    centred: bool = True
    """Pad non-square images on both sides; False pads only the left or the top."""
    antialias: bool = True
    """Apply an antialiasing filter when downscaling images."""
    state: Mode = "mean_std"
    """Normalization of states; see `policies.normalization`."""
    action: Mode = "mean_std"
    """Normalization of actions."""
    delta: tuple[bool, ...] = ()
    """True for each action dimension that is relative to the state at the start of the chunk; see
    `policies.processor.to_delta`. The action statistics are then those of relative actions."""
    aloha: bool = False
    """Convert ALOHA's states and actions to those of pi0's pretraining; see `policies.aloha`."""
    convention: Convention = "ours"
    """Project whose guard against division by zero applies in normalization."""
    gripper_slot: int | None = 7
    """Gripper slot in state and action vectors; None means the first slot after the joints."""
    quiet_slots: bool = True
    """Keep slots that the robot does not use at zero in the flow and out of the loss. False treats
    them like other slots whose actions are zero."""
    prompt_state: bool = False
    """Put the normalized state into the prompt; see `policies.prompts.pi05`."""
    masks_missing: bool = True
    """Whether the weights expect black, masked images for missing cameras. False omits such cameras
    from the model's inputs."""


OURS = InputConfig()
"""Preprocessing for weights trained by this project."""
OPENPI = InputConfig(convention="openpi", gripper_slot=None, quiet_slots=False)
"""Preprocessing for pi0 in openpi (shared/image_tools.py, transforms.py at 15a9616a)."""
_PI05 = {"state": "quantiles", "action": "quantiles", "prompt_state": True}
OURS_PI05, OPENPI_PI05 = (dataclasses.replace(inputs, **_PI05) for inputs in (OURS, OPENPI))
"""Preprocessing for pi0.5, here and in openpi (training/config.py: use_quantile_norm,
ModelTransformFactory)."""
LEROBOT_PI0 = dataclasses.replace(OPENPI, antialias=False, convention="lerobot")
"""Preprocessing for pi0 in LeRobot 0.6 (policies/common/vla_utils.py,
processor/normalize_processor.py)."""
LEROBOT_PI05 = dataclasses.replace(LEROBOT_PI0, **_PI05)
"""Preprocessing for pi0.5 in LeRobot 0.6 (policies/pi05/processor_pi05.py,
configuration_pi05.py)."""
LEROBOT_SMOLVLA = dataclasses.replace(LEROBOT_PI0, centred=False, masks_missing=False)
"""Preprocessing for SmolVLA in LeRobot 0.6 (policies/smolvla/modeling_smolvla.py)."""
