"""A small network that corrects each action of a chunk with the latest observation.

A chunk is as old as its observation: by the time the robot executes its action k, k control steps
have passed. At every control step, the network adds a residual to the action (A2C2, "Leave No
Observation Behind: Real-time Correction for VLA Action Chunks", arXiv 2509.23224).

    action + f(pictures, state, action, k)

In the paper, f also gets features of the policy, from the observation of the chunk; the only trace
of them here is the action. f runs at every control step, for which the policy's vision encoder is
too slow, so three convolutions of its own look at small pictures. As in the paper's code (Kinetix,
train_residual.py), k enters as sine and cosine of 2 pi k / C.
"""

import itertools

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.policies.images import resize_with_pad, to_unit
from lorasp_jax.policies.processor import Processor, RawObservation

IMAGE_SIZE = 32
"""Height and width to which pictures are scaled [pixels]."""
_CHANNELS = (16, 32, 32)
_WIDTH = 256


class CorrectionHead(nnx.Module):
    """Predicts the residual of one action. A new one predicts zero.

    Attributes:
        cameras: the robot's cameras.
        action_dim: A.
        chunk: C.
    """

    def __init__(
        self, cameras: tuple[str, ...], action_dim: int, chunk: int, rngs: nnx.Rngs
    ) -> None:
        """Create a head for chunks `[C, A]` of a robot with these cameras."""
        self.cameras, self.action_dim, self.chunk = cameras, action_dim, chunk
        channels = itertools.pairwise((3 * len(cameras), *_CHANNELS))
        self.convolutions = nnx.List(
            [nnx.Conv(*sizes, kernel_size=(3, 3), strides=2, rngs=rngs) for sizes in channels]
        )
        side = IMAGE_SIZE // 2 ** len(_CHANNELS)
        features = side * side * _CHANNELS[-1] + 2 * action_dim + 2
        self.hidden = nnx.List([nnx.Linear(size, _WIDTH, rngs=rngs) for size in (features, _WIDTH)])
        zeros = nnx.initializers.zeros_init()
        self.out = nnx.Linear(_WIDTH, action_dim, kernel_init=zeros, rngs=rngs)

    def __call__(
        self, images: jax.Array, state: jax.Array, action: jax.Array, index: jax.Array
    ) -> jax.Array:
        """Predict the residual `[B, A]` of normalized actions.

        Args:
            images: `[B, 32, 32, 3 K]` in [-1, 1], the pictures of K cameras.
            state: `[B, A]`, normalized.
            action: `[B, A]`, normalized.
            index: k, `[B]` int32, index of the action in its chunk.
        """
        for convolution in self.convolutions:
            images = nnx.gelu(convolution(images))
        angle = 2 * jnp.pi * index[:, None] / self.chunk
        flat = images.reshape(len(images), -1)
        x = jnp.concatenate([flat, state, action, jnp.sin(angle), jnp.cos(angle)], axis=-1)
        for layer in self.hidden:
            x = nnx.gelu(layer(x))
        return self.out(x)


def residual(
    head: CorrectionHead,
    processor: Processor,
    observation: RawObservation,
    action: jax.Array,
    index: jax.Array,
    *,
    state_noise: jax.Array | float = 0.0,
) -> jax.Array:
    """Predict the residual `[B, A]` of normalized actions from raw observations.

    Args:
        head: the network.
        processor: the policy's.
        observation: the latest one.
        action: `[B, J+1]` of a chunk [rad, m].
        index: k, `[B]` int32, index of the action in its chunk.
        state_noise: `[B, A]`, added to the normalized state, for training.
    """
    pictures = [
        resize_with_pad(to_unit(name, observation["image"][name]), IMAGE_SIZE)
        for name in head.cameras
    ]
    state = observation["state"]
    base = processor.normalize_actions(action[:, None], state)[:, 0]
    images = jnp.concatenate(pictures, axis=-1)
    return head(images, processor.normalize_state(state) + state_noise, base, index)


def correct(
    head: CorrectionHead,
    processor: Processor,
    observation: RawObservation,
    action: jax.Array,
    index: jax.Array,
) -> jax.Array:
    """Return corrected actions `[B, J+1]` [rad, m]; see `residual` for the arguments.

    A residual of zero changes nothing, not even by rounding.
    """
    added = residual(head, processor, observation, action, index)[:, None]
    state = observation["state"]
    change = processor.decode(added, state) - processor.decode(jnp.zeros_like(added), state)
    return action + change[:, 0]
