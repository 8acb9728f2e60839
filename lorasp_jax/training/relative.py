"""Which actions of a robot are learned relative to its state."""

import dataclasses
from collections.abc import Sequence

from lorasp_jax.data.source import Source, grippers
from lorasp_jax.models.inputs import InputConfig
from lorasp_jax.policies import aloha


def for_robot(
    inputs: InputConfig, wanted: bool | None, source: Source | None, joints: int
) -> InputConfig:
    """Return the conventions of a base with the mask of relative actions that fits the robot.

    Args:
        inputs: the base's, whose mask is that of the robot it was trained on.
        wanted: whether actions are relative; None: as in `inputs`.
        source: recordings of the robot; None: simulated, with the gripper last.
        joints: J, such that states have J+1 numbers.

    Raises:
        ValueError: states and actions have different lengths, or are not those of ALOHA and
            `inputs` has its units.
    """
    lengths = joints + 1, source.episode(0, ()).action.shape[-1] if source else joints + 1
    if inputs.aloha and {*lengths} != {aloha.NUMBERS}:
        raise ValueError(
            f"the base has the units of ALOHA, whose states and actions have {aloha.NUMBERS} "
            f"numbers, not {lengths[0]} and {lengths[1]}: pass --model.openpi-config none"
        )
    if wanted is False or not (wanted or inputs.delta):
        mask = ()
    elif not wanted and len(inputs.delta) == lengths[1] <= lengths[0]:
        mask = inputs.delta
    elif len({*lengths}) > 1:
        raise ValueError(
            "relative actions need states and actions of the same dimensions, not "
            f"{lengths[0]} and {lengths[1]}: pass --model.relative-actions False"
        )
    else:
        absolute = _grippers(inputs, source) or [joints]
        mask = tuple(number not in absolute for number in range(joints + 1))
    return dataclasses.replace(inputs, delta=mask)


def _grippers(inputs: InputConfig, source: Source | None) -> Sequence[int]:
    return aloha.GRIPPERS if inputs.aloha else grippers(source) if source else ()
