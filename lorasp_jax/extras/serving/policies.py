"""A policy of this package in the form that the server runs, and its sampler."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.extras.serving import ranks
from lorasp_jax.extras.serving.adapters import OnDevice, is_shared
from lorasp_jax.extras.serving.exported import Description, sampling_options
from lorasp_jax.extras.serving.loading import Loaded
from lorasp_jax.policies.policy import Observation, Policy
from lorasp_jax.policies.processor import Processor
from lorasp_jax.policies.prompt_table import Ids, PromptTable
from lorasp_jax.policies.tokenizer import Tokenizer

Answer = tuple[np.ndarray, np.ndarray | None]
"""Actions f32 `[B, C, J+1]` and mean active ranks `[B]`, None for methods without a gate."""
FAR = 50.0
"""Normalized states beyond this are absurd, such as degrees in place of radians; our choice."""
CACHED_PROMPTS = 1024
"""Number of instructions whose tokens are kept."""


class CompiledPolicy:
    """A policy with a program per batch size, which compiles when first used.

    Policies whose adapters have equal shapes share their programs. Each keeps its own copy of the
    weights, unless its model is a `SharedSampler`.

    Attributes:
        description: what it needs and returns.
        instructions: those of its training.
        plausible: see `plausible_states`.
        policy: the policy itself.
        tokens: gives the tokens of an instruction as `ExportedPolicy.tokens` does.
    """

    def __init__(
        self,
        loaded: Loaded,
        *,
        num_steps: int | None = None,
        max_batch: int = 8,
        guidance: float | None = None,
        place: Callable[[Policy], Policy] = lambda policy: policy,
    ) -> None:
        """Prepare the policy's weights.

        Args:
            loaded: any policy, with its tokenizer.
            num_steps: Euler steps of the flow-matching sampler; None: those of `loaded`.
            max_batch: largest batch.
            guidance: β of guided execution, see `real_time_chunking.sample`; None: no guidance.
            place: applied to the policy before each call, such as an `OnDevice`.
        """
        policy = loaded.policy
        self.description: Description = describe(
            policy,
            num_steps=num_steps or loaded.denoise_steps,
            batch_sizes=batch_sizes(max_batch),
            continues=loaded.continues is not False,  # its files may not say it
            metadata=loaded.metadata,
        )
        self.instructions: tuple[str, ...] = policy.processor.prompts.instructions
        self.plausible: np.ndarray = plausible_states(policy.processor)
        self.policy: Policy = without_prompts(policy)
        self._place = place
        self._guidance = None if guidance is None else np.float32(guidance)
        # Not a method: a cycle of references would keep the weights of a policy that was unloaded.
        self.tokens = _tokens(policy.processor.prompts, loaded.words)

    @property
    def where(self) -> str:
        """Where its weights, of an adapter on a shared base its own, are."""
        place, moves = self._place, is_shared(self) and bool(self.policy.model.own)
        away = moves and isinstance(place, OnDevice) and self.policy not in place
        return "in host memory" if away else "on the device"

    def run(self, batch: Mapping[str, Any]) -> Answer:
        """Return actions and active ranks; see `answer`."""
        steps = self.description.num_steps
        return jax.device_get(
            _program()(self._place(self.policy), batch, self._guidance, num_steps=steps)
        )


def _tokens(table: PromptTable, words: Tokenizer) -> Callable[[str], dict[str, np.ndarray]]:
    """Return a function that gives the tokens of an instruction as `ExportedPolicy.tokens` does."""

    @functools.lru_cache(CACHED_PROMPTS)
    def tokens(instruction: str) -> dict[str, np.ndarray]:
        start = table.with_instructions(words, [instruction]).start
        return {"ids": np.asarray(start.ids[0]), "mask": np.asarray(start.mask[0])}

    return tokens


@functools.cache
def _program() -> Any:
    """Return the compiled `answer`, which all policies share."""
    return jax.jit(answer, static_argnames="num_steps", compiler_options=sampling_options())


def batch_sizes(max_batch: int) -> tuple[int, ...]:
    """Return the powers of two below `max_batch`, and `max_batch`.

    Raises:
        ValueError: `max_batch` is less than 1.
    """
    if max_batch < 1:
        raise ValueError(f"the largest batch must be at least 1, got {max_batch}")
    powers = (2**i for i in range(max_batch.bit_length()))
    return (*(size for size in powers if size < max_batch), max_batch)


def describe(policy: Policy, **settings: Any) -> Description:
    """Describe what a policy needs and returns; `settings` are the fields that it does not say."""
    processor, config = policy.processor, policy.model.config
    sources = dict(processor.cameras) or {name: name for name in config.cameras}
    return Description(
        cameras=tuple(name for name in sources.values() if name),
        image_size=processor.image_size,
        state_dim=len(processor.state_slots),
        action_length=len(processor.action_slots),
        action_dim=config.action_dim,
        chunk=config.chunk,
        masks_missing=processor.inputs.masks_missing,
        centred=processor.inputs.centred,
        antialias=processor.inputs.antialias,
        **settings,
    )


def plausible_states(processor: Processor) -> np.ndarray:
    """Return the bounds `[2, J+1]` of states within `FAR` of the demonstrations' normalized ones.

    Normalization is affine, so two states determine it.
    """
    slots = np.array(processor.state_slots)
    zero, one = (
        np.asarray(processor.normalize_state(jnp.full(len(slots), x)))[slots] for x in (0.0, 1.0)
    )
    with np.errstate(divide="ignore", invalid="ignore"):  # what is not normalized has no bounds
        ends = (np.array([[-FAR], [FAR]]) - zero) / (one - zero)
    return np.where(one == zero, [[-np.inf], [np.inf]], ends)


def without_prompts(policy: Policy) -> Policy:
    """Return the policy with prepared weights and a table of no instructions."""
    prompts = policy.processor.prompts
    start = Ids(*(a[:0] for a in prompts.start))
    empty = dataclasses.replace(prompts, start=start, instructions=(), endings=("",))
    processor = dataclasses.replace(policy.processor, prompts=empty)
    return dataclasses.replace(policy, processor=processor).with_sampler()


def sample(policy: Policy, batch: Mapping[str, Any], *, num_steps: int) -> jax.Array:
    """Return the actions of `answer`."""
    return answer(policy, batch, num_steps=num_steps)[0]


def answer(
    policy: Policy,
    batch: Mapping[str, Any],
    guidance: jax.Array | None = None,
    *,
    num_steps: int,
) -> tuple[jax.Array, jax.Array | None]:
    """Sample `[B, C, J+1]`, and mean active ranks `[B]`, None for methods without an energy gate.

    A row's result does not depend on the other rows.

    Args:
        policy: from `without_prompts`.
        batch: rows of `exported.build_row`, stacked, and their `noise` `[B, C, A]`. With the key
            `previous`, the chunks continue the previous ones.
        guidance: see `real_time_chunking.sample`; it needs the key `overlap`, int32 `[B]`, the
            number of actions that remain of the previous chunk.
        num_steps: Euler steps.
    """
    processor, condition = policy.processor, {}
    if "previous" in batch:
        condition = {
            "prefix": processor.normalize_actions(batch["previous"], batch["state"]),
            "prefix_length": batch["delay"],
            "overlap": batch.get("overlap"),
            "guidance": guidance,
        }
    rows = len(batch["state"])
    chunk, (once, steps) = policy.model.sample_actions(
        None,
        _encode(processor, batch),
        num_steps=num_steps,
        noise=batch["noise"],
        slots=processor.flow_slots,
        summarize=lambda aux: ranks.summed(aux, rows),
        **condition,
    )
    return processor.decode(chunk, batch["state"]), ranks.mean(once, steps)


def _encode(processor: Processor, batch: Mapping[str, Any]) -> Observation:
    """Convert rows to model input, masking cameras without a picture."""
    prompts = dataclasses.replace(processor.prompts, start=Ids(batch["ids"], batch["mask"]))
    observation = dataclasses.replace(processor, prompts=prompts).encode(
        {"image": batch["images"], "state": batch["state"]}, jnp.arange(len(batch["state"]))
    )
    images, masks = dict(observation.images), dict(observation.image_masks)
    sources = dict(processor.cameras) or {name: name for name in batch["images"]}
    for name, source in sources.items():
        if source is not None:
            masks[name] = batch["present"][source]
            images[name] = jnp.where(masks[name][:, None, None, None], images[name], -1)
    return dataclasses.replace(observation, images=images, image_masks=masks)
