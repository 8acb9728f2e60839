"""An actor that chooses the initial noise of a frozen flow (DSRL, arXiv 2506.15799).

The noise of each action of a chunk is w + sqrt(1 - s^2) ξ. ξ ~ N(0, I) is new in every action; w is
the same in all of them. An actor that explores draws w ~ N(m(x), s^2 I), so that with m = 0 the
noise of an action is standard normal, as in training; otherwise w = m(x). (DSRL repeats one noise
in all actions, s = 1, which is far from what a flow is trained on.)

x are the robot's state and the chunk that the flow makes of zero noise: what the policy sees.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Self, TypeVar

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.models import flow_matching
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.perceptron import Network

PATH = "noise_actor"
"""Path of a backbone's actor."""
Model = TypeVar("Model", bound=nnx.Module)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NoiseActor:
    """Chooses w. A pytree.

    Attributes:
        network: m, from x `[D]` to `[A]`.
        chunk: C.
        std: s, from 0 to 1.
    """

    network: Network
    chunk: int = field(metadata={"static": True})
    std: float = field(metadata={"static": True})

    @classmethod
    def init(
        cls, key: jax.Array, config: BackboneConfig, *, std: float, widths: Sequence[int]
    ) -> Self:
        """Create an actor with m about 0; `widths` are those of the hidden layers."""
        size = config.action_dim
        network = Network.init(key, ((1 + config.chunk) * size, *widths), (size,))
        return cls(network, config.chunk, std)

    @classmethod
    def blank(cls, config: BackboneConfig, *, std: float, widths: Sequence[int]) -> Self:
        """Create an actor of zeros, to load values into.

        Raises:
            ValueError: `std` or `widths` are out of range.
        """
        if not 0 < std < 1 or len(widths) > 8 or not all(0 < width <= 4096 for width in widths):
            raise ValueError(f"std {std} or widths {widths} of a noise actor are out of range")
        init = lambda key: cls.init(key, config, std=std, widths=widths)  # noqa: E731
        shapes = jax.eval_shape(init, jax.random.key(0))
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    @property
    def settings(self) -> dict[str, Any]:
        """JSON values from which `blank` makes an actor of equal shapes."""
        widths = [bias.size for _, bias in self.network.layers[:-1]]
        return {"std": self.std, "widths": widths}

    def __call__(self, seen: jax.Array) -> jax.Array:
        """Return m(x) `[B, A]` of x `[B, D]`."""
        return self.network(seen)

    def observe(
        self,
        velocity: flow_matching.Velocity,
        obs: Observation,
        *,
        num_steps: int,
        slots: jax.Array | None = None,
    ) -> jax.Array:
        """Return x `[B, D]`; see `flow_matching.sample` for the arguments."""
        zeros = jnp.zeros((len(obs.state), self.chunk, obs.state.shape[-1]))
        chunk, _ = flow_matching.sample(velocity, zeros, num_steps=num_steps, slots=slots)
        return jnp.concatenate([obs.state[:, None], chunk], axis=1).reshape(len(chunk), -1)

    def mixed(self, shift: jax.Array, noise: jax.Array) -> jax.Array:
        """Return the initial noise `[B, C, A]` of w `[B, A]` and ξ `[B, C, A]`."""
        return shift[:, None] + (1 - self.std**2) ** 0.5 * noise


def attach(model: Model, actor: NoiseActor) -> Model:
    """Return a copy of a backbone with an actor, not trainable."""
    model = nnx.clone(model)
    setattr(model, PATH, nnx.Param(actor))
    return model
