"""Sample action chunks by integrating the flow."""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Self

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.compress import quantization
from lorasp_jax.adapters.layers import prepared
from lorasp_jax.models import flow_matching, real_time_chunking
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.noise_actor import NoiseActor
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.transformer.depth import unstack
from lorasp_jax.models.transformer.layers import LayerAux, ModelAux, merge_action_aux
from lorasp_jax.peft import Method

if TYPE_CHECKING:
    from lorasp_jax.models.backbone import Backbone

NUM_STEPS = 10
"""Flow steps by default: openpi's and LeRobot's number, and so that of published checkpoints."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Sampler:
    """Samples action chunks from a backbone, with input-independent results precomputed once.

    A sampler copies most of the weights; drop all references to the backbone to free the originals.
    In the vision tower and the language model, which run once per call, weights stay quantized if
    that only saves memory. If the GPU multiplies float8, only large float8 kernels do; all smaller
    ones, and those of the action expert, are dequantized.
    The weights are a flat list, because a jitted call with a module of about a thousand arrays has
    too much dispatch latency for some control loops.
    """

    weights: list[jax.Array]
    structure: Any = dataclasses.field(metadata={"static": True})
    """Graph definitions and treedef that rebuild the modules from `weights`."""
    config: BackboneConfig = dataclasses.field(metadata={"static": True})
    methods: tuple[Method, ...] = dataclasses.field(metadata={"static": True})
    """Distinct adapter methods of the backbone."""
    noise_actor: NoiseActor | None = None
    """What chooses the initial noise; None: it is standard normal."""

    @classmethod
    def from_model(cls, model: "Backbone", *, once: bool = False) -> Self:
        """Create a sampler; the backbone is not modified.

        Args:
            model: the backbone.
            once: the sampler is used only once. The prefix then uses the kernels as they are:
                copying them would take longer than it saves.
        """
        models = (_prefix_model(model, once), suffix_model(model))
        graphdefs, states = zip(*map(nnx.split, models), strict=True)
        weights, tree = jax.tree.flatten(states)
        methods = dict.fromkeys(adaptation.methods(model).values())
        actor = None if model.noise_actor is None else model.noise_actor.get_value()
        return cls(weights, (graphdefs, tree), model.config, tuple(methods), actor)

    def sampler(self) -> Self:
        """Return self, for callers that accept a backbone or a sampler."""
        return self

    def sample_actions(
        self,
        key: jax.Array,
        obs: Observation,
        *,
        num_steps: int = NUM_STEPS,
        noise: jax.Array | None = None,
        slots: jax.Array | None = None,
        return_aux: bool = False,
        summarize: Callable[[ModelAux], Any] | None = None,
        prefix: jax.Array | None = None,
        prefix_length: jax.Array | int = 0,
        guidance: float | None = None,
        overlap: jax.Array | int | None = None,
    ) -> Any:
        """Sample action chunks.

        Args:
            key: typed PRNG key; used only if `noise` is None.
            obs: the observation.
            num_steps: Euler steps.
            noise: `[B, C, A]` initial noise of the flow; see `initial_noise`.
            slots: `[A]` bool, slots to sample; the others stay zero. None samples all slots.
            return_aux: also return the adapters' aux. `aux["action"]` has a step axis before the
                layer axis. The aux of action layers that run only once is broadcast over steps.
            summarize: return (summary, summaries) in place of aux: of what runs once, and, with a
                leading step axis, of what runs in each flow step.
            prefix: `[B, P, A]` normalized actions that the chunk must continue, P from 1 to C: what
                remains of the previous chunk. See `real_time_chunking.sample`.
            prefix_length: d, `[]` or `[B]`, number of actions in the prefix that the robot executes
                before it switches to the new chunk, from 0 to P.
            guidance: β of guided real-time chunking; None: the policy is trained for prefixes.
            overlap: `[]` or `[B]`, number of actions in `prefix` that are not padding; None: all.

        Returns:
            `[B, C, A]` f32 normalized actions, or (actions, aux).

        Raises:
            ValueError: the prefix has the wrong shape.
        """
        if noise is None:
            shape = (obs.state.shape[0], self.config.chunk, self.config.action_dim)
            noise = jax.random.normal(key, shape)
        velocity, aux = self.encode(obs)
        noise = self.initial_noise(velocity, obs, noise, num_steps=num_steps, slots=slots)
        if summarize:
            velocity = _summarizing(velocity, summarize)
        sample = flow_matching.sample
        if prefix is not None:
            condition = {"prefix": prefix, "length": prefix_length, "guidance": guidance}
            sample = functools.partial(real_time_chunking.sample, overlap=overlap, **condition)
        actions, action_aux = sample(velocity, noise, num_steps=num_steps, slots=slots)
        if summarize:
            return actions, (summarize(aux), action_aux)
        return (actions, _with_steps(aux, action_aux, num_steps)) if return_aux else actions

    def encode(self, obs: Observation) -> tuple[flow_matching.Velocity, ModelAux]:
        """Return the velocity given an observation, which is encoded once, and the aux of that."""
        prefix_model, suffix_model = self._models()
        prefix, aux = prefix_model.run_prefix(obs)
        return functools.partial(suffix_model.run_suffix, prefix.by_layer(), obs), aux

    def initial_noise(
        self,
        velocity: flow_matching.Velocity,
        obs: Observation,
        noise: jax.Array,
        *,
        num_steps: int,
        slots: jax.Array | None = None,
    ) -> jax.Array:
        """Return standard normal noise `[B, C, A]` as the actor shifts it, if there is an actor."""
        if self.noise_actor is None:
            return noise
        actor = self.noise_actor
        seen = actor.observe(velocity, obs, num_steps=num_steps, slots=slots)
        return actor.mixed(actor(seen), noise)

    def _models(self) -> Iterator["Backbone"]:
        """Rebuild the modules of the prefix and of the flow steps."""
        graphdefs, tree = self.structure
        return map(nnx.merge, graphdefs, jax.tree.unflatten(tree, self.weights))


def _summarizing(
    velocity: flow_matching.Velocity, summarize: Callable[[ModelAux], Any]
) -> flow_matching.Velocity:
    """Let each step return a summary: stacking all of its aux takes time."""

    def summarized(x_t: jax.Array, flow_time: jax.Array) -> tuple[jax.Array, Any]:
        v_t, aux = velocity(x_t, flow_time)
        return v_t, summarize({"action": aux})

    return summarized


def _with_steps(aux: ModelAux, action_aux: LayerAux, num_steps: int) -> ModelAux:
    """Merge the flow steps' aux into the prefix's, whose action layers get an axis of steps."""
    once = aux.get("action", {})
    each_step = jax.tree.map(lambda a: jnp.broadcast_to(a, (num_steps, *a.shape)), once)
    return merge_action_aux({**aux, "action": each_step}, action_aux)


def _prefix_model(model: "Backbone", once: bool) -> "Backbone":
    """Copy a model for the prefix, blocks unstacked so that an outer loop slices no weights."""
    model = nnx.merge(*nnx.split(model))
    model.noise_actor = None  # the sampler has it
    for tower in (model.vision, model.language):
        if isinstance(tower.blocks, nnx.List):  # a `SharedSampler`'s
            for block in tower.blocks:
                prepared.fuse_projections(block, copy_kernels=False)
            continue
        if once or quantization.only_saves_memory(tower.blocks):
            tower.blocks = unstack(prepared.fuse_stack(tower.blocks))
            continue
        tower.blocks = unstack(tower.blocks)
        quantization.dequantize(tower, keep_float8=True)
        for block in tower.blocks:
            prepared.fuse_projections(block)
    return model


def suffix_model(model: "Backbone") -> "Backbone":
    """Copy a model for the flow steps, with input-independent results precomputed."""
    model = nnx.merge(*nnx.split(model))
    del model.vision, model.language
    model.noise_actor = None
    if not isinstance(model.action.blocks, nnx.List):
        model.action.blocks = unstack(model.action.blocks)
    quantization.dequantize(model)
    for module in (model, *(module for _, module in nnx.iter_modules(model.action))):
        prepared.fuse_projections(module)
    return model
