"""A policy: a backbone with the processor of one robot and its tasks."""

import dataclasses
from dataclasses import dataclass
from typing import Any, Self

import jax

from lorasp_jax.models.observation import Observation
from lorasp_jax.models.sampling import NUM_STEPS, Sampler
from lorasp_jax.models.shared_base import SharedSampler
from lorasp_jax.models.transformer.layers import ModelAux
from lorasp_jax.policies.processor import Processor, RawObservation

__all__ = ["ModelAux", "Observation", "Policy"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Policy:
    """Maps raw observations to robot commands. A pytree, usable in `jax.jit` and `jax.lax.scan`.

    Attributes:
        model: the backbone, its `sampler()`, or anything else with `sample_actions`.
        processor: converts between the robot and the backbone.
    """

    model: Any
    processor: Processor

    def with_sampler(self) -> Self:
        """Return a policy for repeated calls, which runs computations on weights alone only once.

        Call it before a `jax.lax` loop, since XLA does not guarantee to hoist these computations.
        """
        if isinstance(self.model, (Sampler, SharedSampler)):
            return self
        return dataclasses.replace(self, model=_sampler(self.model))

    def sample(
        self,
        key: jax.Array,
        observation: RawObservation,
        instruction: jax.Array,
        *,
        num_steps: int = NUM_STEPS,
        return_aux: bool = False,
        previous: jax.Array | None = None,
        prefix_length: jax.Array | int = 0,
        guidance: float | None = None,
    ) -> Any:
        """Sample one action chunk per row; `key` is consumed.

        Args:
            key: typed PRNG key for the initial noise of the flow.
            observation: as returned by `env.observe`, with leading axis B.
            instruction: `[B]` int32, rows of the processor's prompt table.
            num_steps: Euler steps of the flow-matching sampler.
            return_aux: also return the adapters' `Aux`; see the backbone's `sample_actions`.
            previous: `[B, P, J+1]` actions [rad, m] that the robot would execute from now on, which
                the chunk then continues: real-time chunking, see `Sampler.sample_actions`.
            prefix_length: number of these actions that the robot will execute in any case.
            guidance: see `Sampler.sample_actions`.

        Returns:
            `[B, C, J+1]` f32 joint targets [rad] and gripper opening [m], or (chunk, aux).
        """
        condition = {}
        if previous is not None:
            prefix = self.processor.normalize_actions(previous, observation["state"])
            condition = {"prefix": prefix, "prefix_length": prefix_length, "guidance": guidance}
        chunk, aux = self.model.sample_actions(
            key,
            self.processor.encode(observation, instruction),
            num_steps=num_steps,
            slots=self.processor.flow_slots,
            return_aux=True,
            **condition,
        )
        actions = self.processor.decode(chunk, observation["state"])
        return (actions, aux) if return_aux else actions


@jax.jit
def _sampler(model: Any) -> Any:
    return model.sampler()
