"""Policies in the form that the server runs: compiled for fixed batch sizes, one per adapter."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.extras.serving.exported import sampling_options
from lorasp_jax.extras.serving.noise import draw
from lorasp_jax.extras.serving.requests import PolicySpec, Request, choose_prompt, common_spec
from lorasp_jax.policies.policy import Observation, Policy
from lorasp_jax.policies.processor import Processor
from lorasp_jax.policies.prompt_table import Ids
from lorasp_jax.policies.tokenizer import Tokenizer

EXECUTIONS = ("naive", "trained", "guided")
"""How a chunk relates to the previous one; see docs/latency.md."""
CACHED_PROMPTS = 1024
"""Number of instructions whose tokens are kept."""


class Rows(NamedTuple):
    """Input of a compiled policy; NumPy arrays, with leading axis B in a batch.

    Attributes:
        images: camera -> uint8 `[S, S, 3]`, black where there is no picture.
        present: camera -> bool.
        state: f32 `[J+1]`.
        ids, mask: `[T]`, the instruction's tokens.
        index: int32 `[2]`, numbers of the connection and of the request on it; not for `sample`.
        previous: f32 `[C, J+1]`, what remains of the previous chunk, then zeros.
        overlap: int32, number of actions that remain; 0: the new chunk does not continue any.
        delay: int32, number of these that the robot will execute.
    """

    images: dict[str, Any]
    present: dict[str, Any]
    state: Any
    ids: Any
    mask: Any
    index: Any = None
    previous: Any = None
    overlap: Any = None
    delay: Any = None


class CompiledPolicies:
    """Policies of one robot by adapter name, with a program per batch size. See `BatchPolicy`.

    Policies whose adapters have equal shapes share their programs. Each keeps its own copy of the
    weights.
    """

    def __init__(
        self,
        policies: Mapping[str, Policy],
        words: Mapping[str, Tokenizer],
        *,
        prompt: str = "",
        max_batch: int = 8,
        num_steps: int = 10,
        seed: int = 0,
        execution: str = "naive",
        guidance: float = 10.0,
    ) -> None:
        """Prepare the policies' weights; `warm_up` compiles.

        Args:
            policies: by adapter name; the first is the default.
            words: the tokenizer of each policy.
            prompt: the instruction of requests that have none; "" selects the only instruction that
                the policy was trained with, if there is just one.
            max_batch: largest batch.
            num_steps: Euler steps of the flow-matching sampler.
            seed: of the flow's noise.
            execution: one of `EXECUTIONS`.
            guidance: β of guided execution, see `real_time_chunking.sample`.

        Raises:
            ValueError: the policies need different observations.
        """
        self._specs = {name: spec_of(policy) for name, policy in policies.items()}
        self.spec: PolicySpec = dataclasses.replace(common_spec(self._specs), execution=execution)
        self._guidance = np.float32(guidance) if execution == "guided" else None
        self._prompt, self._key, self._num_steps = prompt, jax.random.key(seed), num_steps
        self._tables = {name: policy.processor.prompts for name, policy in policies.items()}
        self._policies = {name: without_prompts(policy) for name, policy in policies.items()}
        self._words = dict(words)
        self._tokens = functools.lru_cache(CACHED_PROMPTS)(self._tokenize)
        self._sample = jax.jit(
            _sample,
            static_argnames=("num_steps", "continues"),
            compiler_options=sampling_options(),
        )
        self.sizes: tuple[int, ...] = batch_sizes(max_batch)

    @property
    def adapters(self) -> tuple[str, ...]:
        """Names of the policies; the first is the default."""
        return tuple(self._policies)

    @property
    def instructions(self) -> dict[str, tuple[str, ...]]:
        """The instructions that each policy was trained with."""
        return {name: spec.instructions for name, spec in self._specs.items()}

    def warm_up(self, progress: Callable[[str, int], None] = lambda *_: None) -> None:
        """Compile and run every program; `progress` is told of each before it starts."""
        spec = self.spec
        picture = np.zeros((spec.image_size, spec.image_size, 3), np.uint8)
        images = dict.fromkeys(spec.cameras, picture)
        state = np.zeros(spec.state_dim, np.float32)
        for adapter in self.adapters:
            prompt = (self._prompt, *self._specs[adapter].instructions, "press the button")
            request = Request(images, state, next(filter(None, prompt)), adapter, False, 0)
            row = self.prepare(request, (0, 0))
            for size in self.sizes:
                progress(adapter, size)
                self.run(adapter, [row] * size)
                self.run(adapter, [row] * size)

    def prepare(self, request: Request, index: tuple[int, int]) -> Rows:
        """Convert a request to a row of a batch.

        Raises:
            ValueError: there is no instruction, or the tokenizer rejects it.
        """
        adapter, spec = request.adapter or self.adapters[0], self.spec
        prompt = choose_prompt(request, self._prompt, self._specs[adapter])
        ids, mask = self._tokens(adapter, prompt)
        black = np.zeros((spec.image_size, spec.image_size, 3), np.uint8)
        return Rows(
            images={camera: request.images.get(camera, black) for camera in spec.cameras},
            present={camera: np.array(camera in request.images) for camera in spec.cameras},
            state=request.state,
            ids=ids,
            mask=mask,
            index=np.array(index, np.int32),
            **_remaining(request, spec),
        )

    def run(self, adapter: str, rows: Sequence[Rows]) -> np.ndarray:
        """Return actions f32 `[B, C, J+1]`."""
        batch = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
        policy = self._policies[adapter]
        options = {"num_steps": self._num_steps, "continues": self.spec.execution != "naive"}
        return np.asarray(self._sample(policy, self._key, batch, self._guidance, **options))

    def _tokenize(self, adapter: str, prompt: str) -> tuple[np.ndarray, np.ndarray]:
        table = self._tables[adapter].with_instructions(self._words[adapter], [prompt])
        return np.asarray(table.start.ids[0]), np.asarray(table.start.mask[0])


def batch_sizes(max_batch: int) -> tuple[int, ...]:
    """Return the powers of two below `max_batch`, and `max_batch`.

    Raises:
        ValueError: `max_batch` is less than 1.
    """
    if max_batch < 1:
        raise ValueError(f"the largest batch must be at least 1, got {max_batch}")
    powers = (2**i for i in range(max_batch.bit_length()))
    return (*(size for size in powers if size < max_batch), max_batch)


def spec_of(policy: Policy) -> PolicySpec:
    """Describe what a policy needs and returns."""
    processor, config = policy.processor, policy.model.config
    sources = dict(processor.cameras) or {name: name for name in config.cameras}
    return PolicySpec(
        cameras=tuple(name for name in sources.values() if name),
        image_size=processor.image_size,
        state_dim=len(processor.robot_slots),
        chunk=config.chunk,
        masks_missing=processor.inputs.masks_missing,
        centred=processor.inputs.centred,
        antialias=processor.inputs.antialias,
        instructions=processor.prompts.instructions,
    )


def without_prompts(policy: Policy) -> Policy:
    """Return the policy with prepared weights and a table of no instructions."""
    prompts = policy.processor.prompts
    empty = dataclasses.replace(
        prompts, start=Ids(*(a[:0] for a in prompts.start)), instructions=()
    )
    processor = dataclasses.replace(policy.processor, prompts=empty)
    return dataclasses.replace(policy, processor=processor).with_sampler()


def _remaining(request: Request, spec: PolicySpec) -> dict[str, np.ndarray]:
    """Return the fields of `Rows` that continue the previous chunk."""
    rest = np.zeros((spec.chunk, spec.state_dim), np.float32)
    overlap = 0
    if request.executed is not None and request.previous is not None:
        overlap = spec.chunk - request.executed
        rest[:overlap] = request.previous[request.executed :]
    return {
        "previous": rest,
        "overlap": np.array(overlap, np.int32),
        "delay": np.array(request.delay, np.int32),
    }


def _encode(processor: Processor, rows: Rows) -> Observation:
    """Convert rows to model input, masking cameras without a picture."""
    prompts = dataclasses.replace(processor.prompts, start=Ids(rows.ids, rows.mask))
    observation = dataclasses.replace(processor, prompts=prompts).encode(
        {"image": rows.images, "state": rows.state}, jnp.arange(len(rows.state))
    )
    images, masks = dict(observation.images), dict(observation.image_masks)
    sources = dict(processor.cameras) or {name: name for name in rows.images}
    for name, source in sources.items():
        if source is not None:
            masks[name] = rows.present[source]
            images[name] = jnp.where(rows.present[source][:, None, None, None], images[name], -1)
    return dataclasses.replace(observation, images=images, image_masks=masks)


def _sample(
    policy: Policy, key: jax.Array, rows: Rows, guidance: jax.Array | None, **options: Any
) -> jax.Array:
    """`sample` with noise that depends on the key and on the rows' indices."""
    config = policy.model.config
    shape = (config.chunk, config.action_dim)
    noise = jax.vmap(lambda index: draw(key, index, shape))(rows.index)
    return sample(policy, rows, noise, guidance=guidance, **options)


def sample(
    policy: Policy,
    rows: Rows,
    noise: jax.Array,
    *,
    num_steps: int,
    continues: bool,
    guidance: jax.Array | None = None,
) -> jax.Array:
    """Sample `[B, C, J+1]`; a row's result does not depend on the other rows.

    Args:
        policy: from `without_prompts`.
        rows: a batch.
        noise: `[B, C, A]`.
        num_steps: Euler steps.
        continues: whether the chunks continue the previous ones, by guidance if it is given.
        guidance: see `real_time_chunking.sample`.
    """
    processor, condition = policy.processor, {}
    if continues:
        condition = {
            "prefix": processor.normalize_actions(rows.previous, rows.state),
            "prefix_length": rows.delay,
            "overlap": rows.overlap,
            "guidance": guidance,
        }
    chunk = policy.model.sample_actions(
        None,
        _encode(processor, rows),
        num_steps=num_steps,
        noise=noise,
        slots=processor.flow_slots,
        **condition,
    )
    return processor.decode(chunk, rows.state)
