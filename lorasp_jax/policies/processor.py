"""Between a robot and a backbone: pictures, statistics, slots, prompts; both ways.

State and action vectors of a backbone have slots. With this project's own weights they are fixed:
joints from slot 0, the gripper in slot 7; published weights have the robot's numbers side by side.
Unused slots are zero.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.inputs import OURS, InputConfig
from lorasp_jax.models.observation import Observation
from lorasp_jax.policies.images import resize_with_pad, to_unit
from lorasp_jax.policies.normalization import normalize, unnormalize
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.statistics import Statistics, check_slots

RawObservation = Mapping[str, Any]
"""{"image": camera -> uint8 `[B, H, W, 3]`, "state": f32 `[B, J+1]`}, joints [rad], gripper [m]."""


def robot_slots(num_joints: int, inputs: InputConfig = OURS) -> tuple[int, ...]:
    """Slot of each of J joints and of the gripper.

    PiPER has (0..5, 7) and Panda (0..6, 7); without a slot of the gripper's own, (0..6) and (0..7).

    Raises:
        ValueError: more joints than slots before the gripper's.
    """
    gripper = num_joints if inputs.gripper_slot is None else inputs.gripper_slot
    if not 0 < num_joints <= gripper:
        raise ValueError(f"a robot has 1 to {gripper} joints here, got {num_joints}.")
    return (*range(num_joints), gripper)


def camera_slots(
    cameras: Sequence[str], robot: Mapping[str, str]
) -> tuple[tuple[str, str | None], ...]:
    """Which of the robot's cameras each of a backbone's pictures comes from, for `Processor`.

    Args:
        cameras: the backbone's, `config.cameras`.
        robot: backbone's name -> robot's name; what is not in it is missing.

    Raises:
        ValueError: a name that the backbone does not have, or nothing at all.
    """
    unknown = sorted(robot.keys() - set(cameras))
    if unknown or not robot:
        raise ValueError(
            f"the backbone's cameras are {', '.join(cameras)}, one of which is needed; "
            f"got {', '.join(unknown) or 'none'}."
        )
    return tuple((name, robot.get(name)) for name in cameras)


def to_delta(actions: jax.Array, state: jax.Array, mask: Sequence[bool]) -> jax.Array:
    """Actions relative to the state they start from (openpi, DeltaActions).

    Args:
        actions: `[..., C, J]`.
        state: `[..., J]`.
        mask: True where an action becomes relative, as joints do and grippers do not; may be
            shorter than J.
    """
    return actions - _start(actions, state, mask)


def to_absolute(actions: jax.Array, state: jax.Array, mask: Sequence[bool]) -> jax.Array:
    """The inverse of `to_delta` (openpi, AbsoluteActions)."""
    return actions + _start(actions, state, mask)


def check_delta(mask: Sequence[bool], num_joints: int) -> None:
    """Raise ValueError if more numbers than a robot has are said to be relative or not."""
    if len(mask) > num_joints + 1:
        raise ValueError(
            f"relative actions are said of {len(mask)} numbers, the robot has {num_joints + 1}: "
            "the weights are another robot's."
        )


def _start(actions: jax.Array, state: jax.Array, mask: Sequence[bool]) -> jax.Array:
    """The state `[..., 1, J]` f32 where the mask is True, else zero."""
    whole = np.zeros(actions.shape[-1], bool)
    whole[: len(mask)] = mask
    return jnp.where(whole, state, 0)[..., None, :].astype(jnp.float32)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Processor:
    """Normalises observations and actions of one robot and its tasks. A pytree.

    Attributes:
        robot_slots: slot of each of the robot's J+1 numbers, see `robot_slots`.
        statistics: of states and actions, per slot.
        prompts: of the instructions.
        image_size: height and width of the backbone's pictures [pixels].
        inputs: what the backbone was trained to see.
        cameras: (backbone's camera, robot's camera or None) each, see `camera_slots`; empty: the
            robot's cameras have the backbone's names.

    Raises:
        ValueError: slots that the statistics do not have.
    """

    robot_slots: tuple[int, ...] = field(metadata={"static": True})
    statistics: Statistics
    prompts: PromptTable
    image_size: int = field(default=64, metadata={"static": True})
    inputs: InputConfig = field(default=OURS, metadata={"static": True})
    cameras: tuple[tuple[str, str | None], ...] = field(default=(), metadata={"static": True})

    @classmethod
    def of(
        cls,
        config: BackboneConfig,
        statistics: Statistics,
        prompts: PromptTable,
        *,
        num_joints: int,
        cameras: Mapping[str, str] | None = None,
        delta: Sequence[bool] | None = None,
    ) -> "Processor":
        """The processor that a backbone's config asks for.

        Args:
            config: sizes and inputs.
            statistics: of the robot's numbers, in their order or already in slots.
            prompts: of the instructions.
            num_joints: J.
            cameras: backbone's name -> robot's name, see `camera_slots`; None: the same names.
            delta: where actions are relative to the state, see `to_delta`; the statistics are
                theirs. None: as the backbone's config says.

        Raises:
            ValueError: joints, statistics or cameras that do not fit the backbone, or relative
                actions that the robot does not have.
        """
        slots = robot_slots(num_joints, config.inputs)
        if statistics.dim != config.action_dim:
            statistics = statistics.placed(slots, config.action_dim)
        chosen = () if cameras is None else camera_slots(config.cameras, cameras)
        inputs = config.inputs
        if delta is not None:
            inputs = dataclasses.replace(inputs, delta=tuple(delta))
        check_delta(inputs.delta, num_joints)
        return cls(slots, statistics, prompts, config.image_size, inputs, chosen)

    @property
    def slot_mask(self) -> np.ndarray:
        """`[A]` bool, True in the robot's slots."""
        mask = np.zeros(self.statistics.dim, bool)
        mask[list(self.robot_slots)] = True
        return mask

    @property
    def flow_slots(self) -> np.ndarray:
        """`[A]` bool, True in the slots that take part in the flow and its loss."""
        return self.slot_mask | (not self.inputs.quiet_slots)

    def encode(
        self, raw: RawObservation, instruction: jax.Array, *, state_noise: jax.Array | None = None
    ) -> Observation:
        """Raw observation to model input; a missing camera's picture is black, with mask False.

        Args:
            raw: pictures of any size and the robot's state.
            instruction: `[B]` int32 rows of the table of prompts.
            state_noise: `[B, A]` that the normalised state has on top in the robot's slots.

        Raises:
            ValueError: pictures that are not uint8 `[B, H, W, 3]`, a camera that is not there, or a
                state of the wrong length.
        """
        state = self._to_slots("state", raw["state"])
        if state_noise is not None:
            state = state + state_noise * self.slot_mask
        sources = dict(self.cameras) or {name: name for name in raw["image"]}
        absent = sorted({name for name in sources.values() if name} - set(raw["image"]))
        if absent:
            raise ValueError(
                f"camera {', '.join(absent)} is not among {', '.join(raw['image']) or 'none'}."
            )
        prompt = self.prompts.encode(instruction, state[:, np.array(self.robot_slots)])
        black = jnp.full((len(state), self.image_size, self.image_size, 3), -1.0)
        return Observation(
            images={
                name: black if source is None else self._image(source, raw["image"][source])
                for name, source in sources.items()
            },
            image_masks={
                name: jnp.full(len(state), source is not None) for name, source in sources.items()
            },
            tokens=prompt.ids,
            token_mask=prompt.mask,
            state=state,
        )

    def normalize_actions(self, actions: jax.Array, state: jax.Array | None = None) -> jax.Array:
        """Actions as the backbone learns them.

        Args:
            actions: `[..., C, J+1]` [rad, m].
            state: `[..., J+1]` raw state at the chunk's start; needed where actions are relative.

        Returns:
            `[..., C, A]` normalised, in slots.
        """
        if self.inputs.delta:
            actions = to_delta(actions, _given(state), self.inputs.delta)
        return self._to_slots("action", actions)

    def decode(self, actions: jax.Array, state: jax.Array | None = None) -> jax.Array:
        """The inverse of `normalize_actions`: `[..., C, A]` -> `[..., C, J+1]` f32 [rad, m]."""
        slots, inputs = np.array(self.robot_slots), self.inputs
        known = {name: array[slots] for name, array in self.statistics.action.items()}
        actions = unnormalize(actions[..., slots], known, inputs.action, inputs.convention)
        return to_absolute(actions, _given(state), inputs.delta) if inputs.delta else actions

    def _to_slots(self, kind: str, values: jax.Array) -> jax.Array:
        """Normalised states or actions `[..., J+1]`, `[..., A]`."""
        slots, dim = np.array(self.robot_slots), self.statistics.dim
        check_slots(self.robot_slots, dim, values.shape[-1])
        known = {name: array[slots] for name, array in getattr(self.statistics, kind).items()}
        scaled = normalize(values, known, getattr(self.inputs, kind), self.inputs.convention)
        return jnp.zeros((*values.shape[:-1], dim)).at[..., slots].set(scaled)

    def _image(self, name: str, image: jax.Array) -> jax.Array:
        centred, antialias = self.inputs.centred, self.inputs.antialias
        unit = to_unit(name, image)
        return resize_with_pad(unit, self.image_size, centred=centred, antialias=antialias)


def _given(state: jax.Array | None) -> jax.Array:
    if state is None:
        raise ValueError("actions are relative to the state here: give the raw state.")
    return state
