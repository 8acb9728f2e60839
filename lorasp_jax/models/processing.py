"""Between a robot and a backbone: pictures, statistics, slots, token table; both ways.

State and action vectors of the backbone have fixed slots: joints from slot 0, the gripper in slot
7, unused slots zero.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.models.observation import Observation

RawObservation = Mapping[str, Any]
"""{"image": camera -> uint8 `[B, H, W, 3]`, "state": f32 `[B, J+1]`}, joints [rad], gripper [m]."""

GRIPPER_SLOT = 7
SMALLEST_STD = 1e-3
"""Floor of the standard deviations [rad, m]: a slot that never moves (a gripper that stays open) is
not blown up to noise."""


def robot_slots(num_joints: int) -> tuple[int, ...]:
    """Slot of each of J joints and of the gripper: PiPER (0..5, 7), Panda (0..6, 7).

    Raises:
        ValueError: more joints than slots before the gripper's.
    """
    if not 0 < num_joints <= GRIPPER_SLOT:
        raise ValueError(f"a robot has 1 to {GRIPPER_SLOT} joints here, got {num_joints}.")
    return (*range(num_joints), GRIPPER_SLOT)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Statistics:
    """Mean and standard deviation per slot, `[A]` f32 each; unused slots have mean 0, std 1."""

    state_mean: jax.Array
    state_std: jax.Array
    action_mean: jax.Array
    action_std: jax.Array

    @classmethod
    def measure(
        cls,
        state: np.ndarray,
        action: np.ndarray,
        valid: np.ndarray,
        *,
        slots: Sequence[int],
        dim: int,
    ) -> "Statistics":
        """Statistics of demonstrations.

        Args:
            state: `[..., J+1]` joints [rad] and gripper [m].
            action: `[..., J+1]` likewise.
            valid: `[...]` bool, False at padding.
            slots: slot of each of the J+1 numbers.
            dim: number of slots, A.

        Raises:
            ValueError: nothing is valid, or the slots do not match the data.
        """
        valid = np.asarray(valid, bool)
        _check_slots(slots, dim, np.shape(state)[-1])
        if not valid.any():
            raise ValueError("statistics need at least one valid step.")
        arrays = []
        for values in (state, action):
            rows = np.asarray(values, np.float64)[valid]
            mean, std = np.zeros(dim, np.float32), np.ones(dim, np.float32)
            mean[list(slots)] = rows.mean(axis=0)
            std[list(slots)] = np.maximum(rows.std(axis=0), SMALLEST_STD)
            arrays += [jnp.asarray(mean), jnp.asarray(std)]
        return cls(*arrays)

    def to_json(self) -> str:
        """JSON object of four lists; exact in fp32."""
        return json.dumps(
            {f.name: np.asarray(getattr(self, f.name)).tolist() for f in fields(self)}, indent=1
        )

    @classmethod
    def from_json(cls, text: str) -> "Statistics":
        """What `to_json` wrote.

        Raises:
            ValueError: not such an object.
        """
        names = [f.name for f in fields(cls)]
        try:
            found = json.loads(text)
            arrays = {name: jnp.asarray(found[name], jnp.float32) for name in names}
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"statistics need lists of numbers {', '.join(names)}.") from error
        shapes = {array.shape for array in arrays.values()}
        if len(shapes) != 1 or len(shapes.pop()) != 1 or set(found) != set(names):
            raise ValueError(f"statistics need lists of one length {', '.join(names)}.")
        return cls(**arrays)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Processor:
    """Normalises observations and actions of one robot and its tasks. A pytree.

    Attributes:
        robot_slots: slot of each of the robot's J+1 numbers, see `robot_slots`.
        statistics: mean and std per slot.
        tokens: `[P, T]` int32, one row per instruction.
        token_mask: `[P, T]` bool.
        image_size: height and width of the backbone's pictures [pixels].

    Raises:
        ValueError: slots that the statistics do not have.
    """

    robot_slots: tuple[int, ...] = field(metadata={"static": True})
    statistics: Statistics
    tokens: jax.Array
    token_mask: jax.Array
    image_size: int = field(default=64, metadata={"static": True})

    @property
    def slot_mask(self) -> np.ndarray:
        """`[A]` bool, True in the robot's slots."""
        mask = np.zeros(self.statistics.state_mean.shape[-1], bool)
        mask[list(self.robot_slots)] = True
        return mask

    def encode(self, raw: RawObservation, instruction: jax.Array) -> Observation:
        """Raw observation to model input.

        Args:
            raw: pictures of any size and the robot's state.
            instruction: `[B]` int32 rows of the token table.

        Raises:
            ValueError: pictures that are not uint8 `[B, H, W, 3]`, or a state of the wrong length.
        """
        statistics = self.statistics
        state = self._to_slots(raw["state"], statistics.state_mean, statistics.state_std)
        images = {name: self._image(name, image) for name, image in raw["image"].items()}
        present = jnp.ones(state.shape[:1], bool)
        return Observation(
            images=images,
            image_masks=dict.fromkeys(images, present),
            tokens=jnp.asarray(self.tokens)[instruction],
            token_mask=jnp.asarray(self.token_mask)[instruction],
            state=state,
        )

    def normalize_actions(self, actions: jax.Array) -> jax.Array:
        """`[..., J+1]` [rad, m] -> `[..., A]` in slots, zero mean and unit variance."""
        return self._to_slots(actions, self.statistics.action_mean, self.statistics.action_std)

    def decode(self, actions: jax.Array) -> jax.Array:
        """The inverse of `normalize_actions`: `[..., A]` -> `[..., J+1]` f32 [rad, m]."""
        slots = np.array(self.robot_slots)
        std, mean = self.statistics.action_std[slots], self.statistics.action_mean[slots]
        return actions[..., slots].astype(jnp.float32) * std + mean

    def _to_slots(self, values: jax.Array, mean: jax.Array, std: jax.Array) -> jax.Array:
        slots = np.array(self.robot_slots)
        _check_slots(self.robot_slots, mean.shape[-1], values.shape[-1])
        scaled = (values.astype(jnp.float32) - mean[slots]) / std[slots]
        return jnp.zeros((*values.shape[:-1], *mean.shape)).at[..., slots].set(scaled)

    def _image(self, name: str, image: jax.Array) -> jax.Array:
        if image.dtype != jnp.uint8 or image.ndim != 4 or image.shape[-1] != 3:
            raise ValueError(
                f"camera {name!r} needs uint8 [B, H, W, 3], got {image.dtype} {image.shape}."
            )
        return resize_with_pad(image.astype(jnp.float32) / 127.5 - 1, self.image_size)


def resize_with_pad(images: jax.Array, size: int) -> jax.Array:
    """`[B, H, W, 3]` in [-1, 1] -> `[B, size, size, 3]`: aspect kept, centred on black (-1).

    Bilinear, antialiased when shrinking, as pi0's preprocessing (openpi, shared/image_tools.py).
    """
    batch, height, width, channels = images.shape
    if height == width == size:
        return images
    longest = max(height, width)
    inner = (max(1, height * size // longest), max(1, width * size // longest))
    shape = (batch, *inner, channels)
    images = jnp.clip(jax.image.resize(images, shape, method="linear"), -1, 1)
    before = [(size - length) // 2 for length in inner]
    after = [size - length - b for length, b in zip(inner, before, strict=True)]
    pad = [(0, 0), (before[0], after[0]), (before[1], after[1]), (0, 0)]
    return jnp.pad(images, pad, constant_values=-1)


def _check_slots(slots: Sequence[int], dim: int, length: int) -> None:
    if len(slots) != length or len(set(slots)) != length or not all(0 <= s < dim for s in slots):
        raise ValueError(
            f"{length} numbers need as many different slots below {dim}, got {tuple(slots)}."
        )
