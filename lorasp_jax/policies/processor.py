"""Convert robot observations to model inputs, and model outputs to robot actions.

A robot uses some of the slots of a backbone's state and action vectors. Joints start at slot 0. The
gripper is in slot 7 with this project's own weights, and directly after the joints with published
weights. Unused slots are zero. The actions of some robots have another length than their states.
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
from lorasp_jax.policies import aloha
from lorasp_jax.policies.images import resize_with_pad, to_unit
from lorasp_jax.policies.normalization import normalize, unnormalize
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.statistics import Statistics, check_slots

RawObservation = Mapping[str, Any]
"""{"image": camera -> uint8 `[B, H, W, 3]`, "state": f32 `[B, J+1]`}, joints [rad], gripper [m]."""


def robot_slots(num_joints: int, inputs: InputConfig = OURS) -> tuple[int, ...]:
    """Return the slots of the J joints and the gripper.

    PiPER has (0..5, 7) and Panda (0..6, 7); without a dedicated gripper slot, (0..6) and (0..7).

    Raises:
        ValueError: no joints, or more joints than there are slots before the gripper's.
    """
    gripper = num_joints if inputs.gripper_slot is None else inputs.gripper_slot
    if not 0 < num_joints <= gripper:
        raise ValueError(f"num_joints must be 1 to {gripper} for this backbone, got {num_joints}")
    return (*range(num_joints), gripper)


def camera_slots(
    cameras: Sequence[str], robot: Mapping[str, str]
) -> tuple[tuple[str, str | None], ...]:
    """Pair each backbone camera with the robot camera that feeds it, or with None, for `Processor`.

    Args:
        cameras: the backbone's cameras, `config.cameras`.
        robot: backbone camera -> robot camera; a camera that is not listed is missing.

    Raises:
        ValueError: a camera that the backbone does not have, or an empty mapping.
    """
    unknown = sorted(robot.keys() - set(cameras))
    if unknown or not robot:
        raise ValueError(f"keys of cameras must be among {cameras}, got {robot}")
    return tuple((name, robot.get(name)) for name in cameras)


def to_delta(actions: jax.Array, state: jax.Array, mask: Sequence[bool]) -> jax.Array:
    """Make actions relative to the state at the start of their chunk (openpi, DeltaActions).

    Args:
        actions: `[..., C, J+1]`, or of another length.
        state: `[..., J+1]`.
        mask: True for dimensions to make relative, usually the joints and not the gripper, which
            are the same in states and actions. Missing trailing entries are False.
    """
    return actions - _offset(actions, state, mask)


def to_absolute(actions: jax.Array, state: jax.Array, mask: Sequence[bool]) -> jax.Array:
    """Invert `to_delta` (openpi, AbsoluteActions)."""
    return actions + _offset(actions, state, mask)


def check_delta(mask: Sequence[bool], state_length: int, action_length: int) -> None:
    """Raise ValueError if a delta mask is longer than the robot's state or action vector."""
    if len(mask) > min(state_length, action_length):
        raise ValueError(
            f"delta mask has {len(mask)} entries, the state {state_length} and the actions "
            f"{action_length}"
        )


def known_state(state: jax.Array, inputs: InputConfig) -> jax.Array:
    """Return raw states `[..., J+1]` in the joint space that the weights know."""
    return aloha.state_to_pi0(state) if inputs.aloha else state


def known_actions(actions: jax.Array, state: Any, inputs: InputConfig) -> jax.Array:
    """Return raw actions `[..., C, n]` in that space, those of `inputs.delta` as relative."""
    if inputs.aloha:
        actions = aloha.actions_to_pi0(actions)
    return to_delta(actions, known_state(state, inputs), inputs.delta) if inputs.delta else actions


def _offset(actions: jax.Array, state: jax.Array, mask: Sequence[bool]) -> jax.Array:
    """Return the state f32 where the mask is True, else zero, as long as actions, `[..., 1, n]`."""
    offset = jnp.where(np.array(mask, bool), state[..., : len(mask)], 0).astype(jnp.float32)
    missing = actions.shape[-1] - len(mask)
    return jnp.pad(offset, [*[(0, 0)] * (offset.ndim - 1), (0, missing)])[..., None, :]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Datasets:
    """What differs between the D datasets that a policy learns from. A pytree.

    Attributes:
        statistics: those of each, by slot, arrays `[D, A]`.
        present: robot camera -> which datasets have it, bool `[D]`.
        names: D names.
    """

    statistics: Statistics
    present: Mapping[str, jax.Array]
    names: tuple[str, ...] = field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Processor:
    """Converts observations and actions of one robot and its tasks. A pytree.

    Attributes:
        state_slots: slots of the state's J+1 dimensions; see the function `robot_slots`.
        action_slots: slots of the action's dimensions, usually the same.
        statistics: statistics of states and actions, by slot.
        prompts: tokenized prompts of the instructions.
        image_size: height and width of the backbone's images [pixels].
        inputs: input conventions that the backbone was trained with.
        cameras: pairs (backbone camera, robot camera or None), see `camera_slots`; empty if robot
            and backbone use the same names.
        datasets: what differs between the datasets of a run, see `of_rows`; None: there is one.
        present: robot camera -> which rows of a batch have it, bool `[B]`; all without an entry.
    """

    state_slots: tuple[int, ...] = field(metadata={"static": True})
    action_slots: tuple[int, ...] = field(metadata={"static": True})
    statistics: Statistics
    prompts: PromptTable
    image_size: int = field(default=64, metadata={"static": True})
    inputs: InputConfig = field(default=OURS, metadata={"static": True})
    cameras: tuple[tuple[str, str | None], ...] = field(default=(), metadata={"static": True})
    datasets: Datasets | None = None
    present: Mapping[str | None, jax.Array] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        config: BackboneConfig,
        statistics: Statistics,
        prompts: PromptTable,
        *,
        num_joints: int,
        action_length: int | None = None,
        cameras: Mapping[str, str] | None = None,
    ) -> "Processor":
        """Create the processor for a backbone's config.

        Args:
            config: the backbone's sizes and input conventions. With `inputs.delta`, the statistics
                of actions must be those of relative ones.
            statistics: the robot's statistics, in the order of its joints or already in slots.
            prompts: tokenized prompts of the instructions.
            num_joints: J, such that states have J+1 numbers.
            action_length: length of the actions; None: J+1, too.
            cameras: backbone camera -> robot camera, see `camera_slots`; None if the names are
                equal.

        Raises:
            ValueError: joints, statistics or cameras do not fit the backbone, or the delta mask is
                longer than the robot's states or actions.
        """
        action_length = action_length or num_joints + 1
        slots = robot_slots(num_joints, config.inputs)
        action_slots = robot_slots(action_length - 1, config.inputs)
        if {statistics.dim, statistics.action_length} != {config.action_dim}:
            statistics = statistics.to_slots(slots, config.action_dim, action_slots)
        pairs = () if cameras is None else camera_slots(config.cameras, cameras)
        inputs = config.inputs
        check_delta(inputs.delta, len(slots), len(action_slots))
        if inputs.aloha and {len(slots), len(action_slots)} != {aloha.NUMBERS}:
            raise ValueError(
                f"ALOHA's states and actions have {aloha.NUMBERS} numbers, got {len(slots)} and "
                f"{len(action_slots)}"
            )
        return cls(slots, action_slots, statistics, prompts, config.image_size, inputs, pairs)

    def shared(self) -> "Processor":
        """Return a processor for rows of the prompt table alone; see `PromptTable.shared`."""
        return dataclasses.replace(self, prompts=self.prompts.shared())

    def of_rows(self, dataset: jax.Array | None) -> "Processor":
        """Return a processor for B rows of these datasets, `[B]` int32; None: of the robot."""
        if dataset is None or self.datasets is None:
            return self
        rows = jax.tree.map(lambda array: array[dataset], self.datasets)
        action = {name: array[:, None] for name, array in rows.statistics.action.items()}
        statistics = Statistics(rows.statistics.state, action)
        changed = {"statistics": statistics, "present": rows.present, "datasets": None}
        return dataclasses.replace(self, **changed)

    def of_dataset(self, name: str) -> "Processor":
        """Return a processor for the robot of one of the datasets: its statistics and cameras."""
        assert self.datasets is not None
        row = self.datasets.names.index(name)
        own = jax.tree.map(lambda array: array[row], self.datasets)
        missing = {camera for camera, present in own.present.items() if not present}
        cameras = tuple((slot, None if x in missing else x) for slot, x in self.cameras)
        changed = {"statistics": own.statistics, "cameras": cameras, "datasets": None}
        return dataclasses.replace(self, **changed)

    @property
    def flow_slots(self) -> np.ndarray:
        """Mask of the slots that carry flow noise and count in the loss, `[A]` bool."""
        return self._mask(self.action_slots) | (not self.inputs.quiet_slots)

    def encode(
        self, raw: RawObservation, instruction: jax.Array, *, state_noise: jax.Array | None = None
    ) -> Observation:
        """Convert a raw observation to model input.

        A backbone camera without a robot camera gets black images and a False mask.

        Args:
            raw: images of any size and the robot's state.
            instruction: `[B]` int32 rows of the prompt table.
            state_noise: `[B, A]`, added to the normalized state in the robot's slots.

        Raises:
            ValueError: an image is not uint8 `[B, H, W, 3]`, a camera is missing from `raw`, or the
                state has the wrong length.
        """
        state = self.normalize_state(raw["state"])
        if state_noise is not None:
            state = state + state_noise * self._mask(self.state_slots)
        sources = dict(self.cameras) or {name: name for name in raw["image"]}
        missing = sorted({name for name in sources.values() if name} - set(raw["image"]))
        if missing:
            raise ValueError(f"the observation lacks camera {missing[0]}, got {[*raw['image']]}")
        prompt = self.prompts.encode(instruction, state[:, np.array(self.state_slots)])
        black = jnp.full((len(state), self.image_size, self.image_size, 3), -1.0)
        return Observation(
            images={
                name: black if source is None else self._image(source, raw["image"][source])
                for name, source in sources.items()
            },
            image_masks={
                name: jnp.broadcast_to(self.present.get(source, source is not None), len(state))
                for name, source in sources.items()
            },
            tokens=prompt.ids,
            token_mask=prompt.mask,
            state=state,
        )

    def normalize_state(self, state: jax.Array) -> jax.Array:
        """Normalize states and put them into the backbone's slots.

        `[..., J+1]` [rad, m] -> `[..., A]`.
        """
        return self._to_slots("state", self.state_slots, known_state(state, self.inputs))

    def normalize_actions(self, actions: jax.Array, state: jax.Array | None = None) -> jax.Array:
        """Normalize actions and put them into the backbone's slots.

        Args:
            actions: `[..., C, J+1]` [rad, m], or of the length of `action_slots`.
            state: `[..., J+1]` raw state at the start of the chunk; required for relative actions.

        Returns:
            `[..., C, A]`.
        """
        if self.inputs.delta:
            self._require(state)
        known = known_actions(actions, state, self.inputs)
        return self._to_slots("action", self.action_slots, known)

    def decode(self, actions: jax.Array, state: jax.Array | None = None) -> jax.Array:
        """Invert `normalize_actions`: `[..., C, A]` -> `[..., C, J+1]` f32 [rad, m]."""
        slots, inputs = np.array(self.action_slots), self.inputs
        stats = {name: array[..., slots] for name, array in self.statistics.action.items()}
        actions = unnormalize(actions[..., slots], stats, inputs.action, inputs.convention)
        if inputs.delta:
            actions = to_absolute(actions, known_state(self._require(state), inputs), inputs.delta)
        return aloha.actions_from_pi0(actions) if inputs.aloha else actions

    def _require(self, state: jax.Array | None) -> jax.Array:
        """Return the state; raise ValueError if there is none."""
        if state is None:
            raise ValueError("this backbone uses relative actions: pass the raw state")
        return state

    def _mask(self, slots: Sequence[int]) -> np.ndarray:
        """Return the mask of these slots, `[A]` bool."""
        return np.isin(np.arange(self.statistics.dim), slots)

    def _to_slots(self, kind: str, slots: Sequence[int], values: jax.Array) -> jax.Array:
        """Normalize states or actions `[..., n]` and return them in slots, `[..., A]`."""
        dim, at = self.statistics.dim, np.array(slots)
        check_slots(slots, dim, values.shape[-1])
        stats = {name: array[..., at] for name, array in getattr(self.statistics, kind).items()}
        normalized = normalize(values, stats, getattr(self.inputs, kind), self.inputs.convention)
        return jnp.zeros((*values.shape[:-1], dim)).at[..., at].set(normalized)

    def _image(self, name: str, image: jax.Array) -> jax.Array:
        centred, antialias = self.inputs.centred, self.inputs.antialias
        unit = to_unit(name, image)
        return resize_with_pad(unit, self.image_size, centred=centred, antialias=antialias)
