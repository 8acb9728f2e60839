"""Action chunks by integrating the flow, with what depends on weights alone computed once."""

import dataclasses
import functools
from typing import Any, Protocol, Self, cast

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.layers import prepared
from lorasp_jax.models import flow_matching
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.transformer.depth import unstacked
from lorasp_jax.models.transformer.layers import LayerAux, ModelAux, with_action
from lorasp_jax.peft import Method


class FlowModel(prepared.JoinsLayers, Protocol):
    """What a sampler reads of a backbone, see `backbone.Backbone`."""

    config: BackboneConfig
    vision: Any
    language: Any
    action: Any

    def run_prefix(self, obs: Observation) -> tuple[Any, ModelAux]:
        """What is computed once per observation."""
        ...

    def run_suffix(
        self, prefix: Any, obs: Observation, x_t: jax.Array, flow_time: jax.Array
    ) -> tuple[jax.Array, LayerAux]:
        """What is computed in every step of the flow."""
        ...


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["weights"],
    meta_fields=["structure", "config", "methods"],
)
@dataclasses.dataclass(frozen=True, eq=False)
class Sampler:
    """A backbone that draws action chunks, with what depends on weights alone computed once.

    That takes the memory of the backbone's weights once more if nobody lets go of the backbone. Its
    arrays are a plain list: to give `jax.jit` a module of a thousand takes longer than some robots
    have.
    """

    weights: list[jax.Array]
    structure: Any
    """Graphs and tree that make modules of the weights."""
    config: BackboneConfig
    methods: tuple[Method, ...]
    """Of the backbone's adapters, each once."""

    @classmethod
    def of(cls, model: FlowModel) -> Self:
        """The sampler of a backbone, which stays as it is."""
        graphdefs, states = zip(*map(nnx.split, (_reading(model), _acting(model))), strict=True)
        weights, tree = jax.tree.flatten(states)
        methods = dict.fromkeys(adaptation.methods(cast(nnx.Module, model)).values())
        return cls(weights, (graphdefs, tree), model.config, tuple(methods))

    def sampler(self) -> Self:
        """Itself, as it is ready for many calls."""
        return self

    def sample_actions(
        self,
        key: jax.Array,
        obs: Observation,
        *,
        num_steps: int = 10,
        noise: jax.Array | None = None,
        slots: jax.Array | None = None,
        return_aux: bool = False,
    ) -> Any:
        """Draw action chunks; the key is consumed for `noise` if that is not given.

        Args:
            key: typed random key.
            obs: what the policy sees.
            num_steps: Euler steps.
            noise: `[B, C, A]` start of the flow.
            slots: `[A]` bool, the robot's slots; the others stay zero. None: all.
            return_aux: also return the adapters' reports; those of "action" get a leading axis of
                steps, before the layers'. What ran once counts as if it had run in every step.

        Returns:
            `[B, C, A]` f32 normalised actions, or (actions, aux).
        """
        if noise is None:
            shape = (obs.state.shape[0], self.config.chunk, self.config.action_dim)
            noise = jax.random.normal(key, shape)
        graphdefs, tree = self.structure
        reading, acting = map(nnx.merge, graphdefs, jax.tree.unflatten(tree, self.weights))
        prefix, aux = reading.run_prefix(obs)
        actions, action_aux = flow_matching.sample(
            lambda x_t, t: acting.run_suffix(prefix, obs, x_t, t),
            noise,
            num_steps=num_steps,
            slots=slots,
        )
        if not return_aux:
            return actions
        once = jax.tree.map(
            lambda a: jnp.broadcast_to(a, (num_steps, *a.shape)), aux.get("action", {})
        )
        return actions, with_action({**aux, "action": once}, action_aux)


def _reading(model: FlowModel) -> FlowModel:
    """A copy for a prefix without gradient, in which no loop copies each layer's weights."""
    model = nnx.merge(*nnx.split(model))
    for tower in (model.vision, model.language):
        tower.blocks = unstacked(prepared.join_stack(tower.blocks))
    return model


def _acting(model: FlowModel) -> FlowModel:
    """A copy for the steps of a flow, in which nothing depends on weights alone any more."""
    model = nnx.merge(*nnx.split(model))
    del model.vision, model.language
    model.action.blocks = unstacked(model.action.blocks)
    for module in (model, *(module for _, module in nnx.iter_modules(model.action))):
        if isinstance(module, prepared.JoinsLayers):
            module.join_layers()
    return model
