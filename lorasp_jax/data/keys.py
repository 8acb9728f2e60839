"""Feature mapping of a LeRobot dataset, apart from the reader, which is slow to import."""

import dataclasses
from collections.abc import Mapping
from typing import Literal

from lorasp_jax.peft import fields


@dataclasses.dataclass(frozen=True)
class Keys:
    """Which features of a dataset contain state, action and images, and in which units.

    In state and action, the joints come first, then the gripper opening.

    Attributes:
        state: feature with the measured joints and gripper.
        action: feature with the commanded joints and gripper.
        state_numbers: names or indices of the state dimensions to use, in order; all if empty.
        action_numbers: the same for the action.
        grippers: names or indices of the gripper openings among the dimensions in use, of which two
            arms have two; if empty, those with "gripper" in their names, or else the last one.
        cameras: camera -> feature; if empty, all image features, named without the prefix
            "observation.images.".
        angles: unit of the joints.
        gripper: unit of the gripper opening.
        every: keep every N-th frame, paired with the last action before the next kept frame; 3
            turns 30 Hz into 10 Hz.
        image_size: maximum length of the longer image side [px]; larger images are downscaled. 0
            means no limit.
    """

    state: str = "observation.state"
    action: str = "action"
    state_numbers: tuple[str, ...] = ()
    action_numbers: tuple[str, ...] = ()
    grippers: tuple[str, ...] = ()
    cameras: Mapping[str, str] = dataclasses.field(default_factory=dict)
    angles: Literal["radians", "degrees"] = "radians"
    gripper: Literal["metres", "millimetres"] = "metres"
    every: int = 1
    image_size: int = 0

    def __post_init__(self) -> None:
        fields.check_fields(self)
        texts = (
            [*self.cameras, *self.cameras.values()] if isinstance(self.cameras, Mapping) else [0]
        )
        if not all(isinstance(text, str) for text in texts):
            raise ValueError(f"cameras must map names to features, got {self.cameras!r}")
        if self.every < 1 or self.image_size < 0:
            raise ValueError("every must be at least 1 and image_size at least 0")
