"""What is what in a LeRobot dataset; apart from its reader, which is slow to import."""

import dataclasses
from collections.abc import Mapping
from typing import Literal

from lorasp_jax.peft import _fields


@dataclasses.dataclass(frozen=True)
class Keys:
    """Which of a dataset's features are what, and in which units.

    State and action are joints first, the gripper's opening last.

    Attributes:
        state: the feature with the measured joints and gripper.
        action: the feature with the commanded ones.
        state_numbers: names or indices of the state's numbers that are wanted, in order; empty:
            all.
        action_numbers: likewise of the action's.
        cameras: name here -> feature; empty: all pictures, without the
            observation.images. of their names.
        angles: unit of the joints.
        gripper: unit of the gripper.
        every: only every so many-th frame is taken, with the last action before the next one that
            is: 3 makes 10 Hz of 30 Hz.
        image_size: pictures are reduced so that the longer side has at most so many pixels; 0: as
            they are.
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
        """Checks the fields."""
        _fields.check_fields(self)
        if not isinstance(self.cameras, Mapping):
            raise ValueError(f"cameras must be a mapping, name -> feature, got {self.cameras!r}")
        for name, feature in self.cameras.items():
            if not isinstance(name, str) or not isinstance(feature, str):
                raise ValueError(f"cameras must be texts, got {name!r} -> {feature!r}")
        if self.every < 1 or self.image_size < 0:
            raise ValueError(
                f"every must be at least 1 and image_size at least 0, "
                f"got {self.every} and {self.image_size}"
            )
