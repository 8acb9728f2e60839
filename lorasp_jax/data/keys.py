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
    cameras: Mapping[str, str] = dataclasses.field(default_factory=dict)
    angles: Literal["radians", "degrees"] = "radians"
    gripper: Literal["metres", "millimetres"] = "metres"
    every: int = 1
    image_size: int = 0

    def __post_init__(self) -> None:
        fields.check_fields(self)
        if not isinstance(self.cameras, Mapping):
            raise ValueError(f"cameras must be a mapping, name -> feature, got {self.cameras!r}")
        for name, feature in self.cameras.items():
            if not isinstance(name, str) or not isinstance(feature, str):
                raise ValueError(f"cameras must be str -> str, got {name!r} -> {feature!r}")
        if self.every < 1 or self.image_size < 0:
            raise ValueError(
                f"every must be at least 1 and image_size at least 0, "
                f"got {self.every} and {self.image_size}"
            )
