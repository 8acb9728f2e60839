"""A policy: a backbone together with the processor of one robot and its tasks."""

import dataclasses
from dataclasses import dataclass
from typing import Any, Self

import jax

from lorasp_jax.models.observation import Observation
from lorasp_jax.policies.processor import Processor, RawObservation

__all__ = ["Observation", "Policy"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Policy:
    """From raw observations to commands. A pytree: `jax.jit`, `scan` and `device_put` take it.

    Attributes:
        model: backbone, or its `sampler()` for many calls: what has `sample_actions`.
        processor: what stands between the robot and the backbone.
    """

    model: Any
    processor: Processor

    def with_sampler(self) -> Self:
        """The same policy for many calls: what depends on weights alone is computed here, once.

        In a loop of `jax.lax`, call this before it: that XLA moves such work out of a loop is seen
        on a CPU, and promised nowhere.
        """
        return dataclasses.replace(self, model=self.model.sampler())

    def sample(
        self,
        key: jax.Array,
        observation: RawObservation,
        instruction: jax.Array,
        *,
        num_steps: int = 10,
        return_aux: bool = False,
    ) -> Any:
        """Draw one action chunk per row; `key` is consumed.

        Args:
            key: typed random key of the flow's starting noise.
            observation: what `env.observe` returns, leading axis B.
            instruction: `[B]` int32, rows of the processor's token table.
            num_steps: Euler steps of the flow-matching sampler.
            return_aux: also return the adapters' reports, see the backbone's `sample_actions`.

        Returns:
            `[B, C, J+1]` f32 joint targets [rad] and gripper opening [m], or (chunk, aux).
        """
        chunk, aux = self.model.sample_actions(
            key,
            self.processor.encode(observation, instruction),
            num_steps=num_steps,
            slots=self.processor.flow_slots,
            return_aux=True,
        )
        actions = self.processor.decode(chunk, observation["state"])
        return (actions, aux) if return_aux else actions
