"""Prompts for a robot, tokenized in advance because tokenizers cannot run inside `jax.jit`.

pi0.5's prompt contains the state, as in "Task: press the button, State: 12 130 7;\\nAction: ". Its
ids are concatenated from tabulated parts: the text before the numbers, each number with its leading
space, and the last number with the text after it. This is correct only if the tokenizer never
merges a number with its neighbors. `_check_merges` verifies that for every pair of numbers.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.policies import prompts
from lorasp_jax.policies.tokenizer import Tokenizer

SHARED_ROWS = 64
"""The tables of `PromptTable.shared` have a multiple of as many rows."""


class Ids(NamedTuple):
    """Token ids `[N, K]` int32, each row padded on the right, and mask `[N, K]` bool."""

    ids: jax.Array
    mask: jax.Array

    def gather(self, rows: jax.Array) -> "Ids":
        """Gather the rows with indices `[B, n]` or `[B]`, and flatten the result to `[B, n K]`."""
        return Ids(*(jnp.asarray(a)[rows].reshape(len(rows), -1) for a in self))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PromptTable:
    """Tokenized prompts by instruction. A pytree.

    Attributes:
        start: `[P, T]`, one row per instruction: the prompt, or the part of it before the state.
        numbers: one row per bin, the tokens of a state value with its leading space. Row 0 is bin
            -1, for values below -1. None if prompts do not contain the state.
        last: the same for the last state value, followed by the end of the prompt.
        instructions: P strings.
        endings: texts that follow every instruction; `start` has P rows for each of them. What
            follows the first is what a policy is asked to do.
    """

    start: Ids
    numbers: Ids | None = None
    last: Ids | None = None
    instructions: tuple[str, ...] = field(default=(), metadata={"static": True})
    endings: tuple[str, ...] = field(default=("",), metadata={"static": True})

    @classmethod
    def of(
        cls,
        tokenizer: Tokenizer,
        instructions: Sequence[str],
        config: BackboneConfig,
        *,
        num_joints: int,
        endings: Sequence[str] = ("",),
    ) -> "PromptTable":
        """Tokenize the instructions for a backbone.

        Args:
            tokenizer: the tokenizer that belongs to the backbone's weights.
            instructions: P strings.
            config: the backbone's config; if `inputs.prompt_state`, prompts contain the state.
            num_joints: J, the robot's number of joints.
            endings: texts that follow every instruction, see the class.

        Raises:
            ValueError: the endings do not fit into the prompts, the tokenizer rejects an
                instruction, gives ids beyond the backbone's vocabulary, or merges state values with
                their neighbors.
        """
        texts = [text + ending for ending in endings for text in instructions]
        if config.inputs.prompt_state:
            table = _with_state(tokenizer, texts, config.max_tokens, num_joints + 1)
        else:
            table = cls(_ids(*tokenizer.encode(texts, config.max_tokens)))
        _check_endings(np.asarray(table.start.ids), endings, instructions)
        max_id = max(int(leaf.max()) for leaf in jax.tree.leaves(table))
        if max_id >= config.vocabulary:
            raise ValueError(
                f"the tokenizer has token {max_id}, the backbone's vocabulary {config.vocabulary}"
            )
        given = {"instructions": tuple(instructions), "endings": tuple(endings)}
        return dataclasses.replace(table, **given)

    def rows(self, instructions: Sequence[str]) -> np.ndarray:
        """Return the rows of these instructions, `[N]` int32.

        Raises:
            ValueError: the table lacks one of them.
        """
        if missing := sorted(set(instructions) - set(self.instructions)):
            raise ValueError(f"the policy has no prompt for {missing[0]!r}")
        return np.array([self.instructions.index(text) for text in instructions], np.int32)

    def only(self, instructions: Sequence[str]) -> "PromptTable":
        """Return the table of some of its instructions; errors are those of `rows`."""
        count = len(self.instructions)
        rows = self.rows(instructions) + count * np.arange(len(self.endings))[:, None]
        start = Ids(*(jnp.asarray(array)[rows.reshape(-1)] for array in self.start))
        return dataclasses.replace(self, start=start, instructions=tuple(instructions))

    def shared(self) -> "PromptTable":
        """Drop the instructions and repeat rows up to a multiple of `SHARED_ROWS`.

        Programs that take such a table are the same for most sets of tasks.
        """
        count = len(self.start.ids)
        rows = np.arange(-(-count // SHARED_ROWS) * SHARED_ROWS) % count
        start = Ids(*(jnp.asarray(np.asarray(array)[rows]) for array in self.start))
        return dataclasses.replace(self, start=start, instructions=())

    def plain(self) -> "PromptTable":
        """Return the table whose first rows are instructions with the last ending, which is empty.

        Programs that take this table take that one, too.
        """
        count = len(self.instructions)
        start = Ids(*(jnp.roll(jnp.asarray(array), count, axis=0) for array in self.start))
        return dataclasses.replace(self, start=start)

    def with_instructions(self, tokenizer: Tokenizer, instructions: Sequence[str]) -> "PromptTable":
        """Return a table of other instructions, as long as these, with the first ending alone.

        Args:
            tokenizer: the tokenizer that the table was made with.
            instructions: P strings.

        Raises:
            ValueError: the tokenizer rejects an instruction.
        """
        max_tokens = self.start.ids.shape[1]
        texts = [text + self.endings[0] for text in instructions]
        if self.numbers is None:
            start = tokenizer.encode(texts, max_tokens)
        else:
            starts = [prompts.pi05_start(text) for text in texts]
            ids, mask = _encode_complete(tokenizer, starts, max_tokens)
            start = ids[:, :max_tokens], mask[:, :max_tokens]
        given = {"instructions": tuple(instructions), "endings": self.endings[:1]}
        return dataclasses.replace(self, start=_ids(*start), **given)

    def encode(self, instruction: jax.Array, state: jax.Array) -> Ids:
        """Return the prompts `[B, T]`.

        Args:
            instruction: `[B]` int32 rows of the table.
            state: `[B, J+1]`, normalized; used only if prompts contain the state.
        """
        start = self.start.gather(instruction)
        if self.numbers is None or self.last is None:
            return start
        rows = jnp.digitize(state, prompts.EDGES)  # bin -1 is row 0
        parts = start, self.numbers.gather(rows[:, :-1]), self.last.gather(rows[:, -1])
        ids, mask = (jnp.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True))
        order = jnp.argsort(~mask, axis=1, stable=True)  # moves the padding to the end
        order = order[:, : start.ids.shape[1]]
        return Ids(*(jnp.take_along_axis(a, order, axis=1) for a in (ids, mask)))


def _check_endings(ids: np.ndarray, endings: Sequence[str], instructions: Sequence[str]) -> None:
    """Raise ValueError if prompts of an instruction are equal, because their ends are cut off."""
    rows = ids.reshape(len(endings), len(instructions), -1)
    for number, text in enumerate(instructions):
        if len(np.unique(rows[:, number], axis=0)) < len(endings):
            raise ValueError(f"{text!r} leaves no room for {endings[0]!r} in {ids.shape[1]} tokens")


def _with_state(
    tokenizer: Tokenizer, instructions: Sequence[str], max_tokens: int, num_values: int
) -> PromptTable:
    """Return the table of prompts that contain a state of `num_values` dimensions."""
    starts = [prompts.pi05_start(text) for text in instructions]
    texts = [f"{starts[0]} {number}" for number in range(-1, prompts.STATE_BINS)]
    last_texts = [text + prompts.PI05_END for text in texts]
    ids, mask = _encode_complete(tokenizer, starts, max_tokens)
    skip = int(mask[0].sum())
    numbers, last = _suffixes(tokenizer, texts, skip), _suffixes(tokenizer, last_texts, skip)
    _check_merges(tokenizer, instructions, numbers, last)
    longest = _bin_centers(np.full(num_values, numbers.mask.sum(axis=1).argmax() - 1))
    full_prompts = [prompts.pi05(text, longest) for text in instructions]
    tokenizer.encode(full_prompts, max_tokens, complete=True)  # warns or raises if one is too long
    return PromptTable(_ids(ids[:, :max_tokens], mask[:, :max_tokens]), numbers, last)


def _check_merges(
    tokenizer: Tokenizer, instructions: Sequence[str], numbers: Ids, last: Ids
) -> None:
    """Raise ValueError unless the assembled ids equal the tokenizer's for every pair of numbers."""
    rows = np.arange(prompts.STATE_BINS + 1)
    # One prompt per number n, in which n alternates with all numbers: n, n+1, n, n+2, ..., n, n.
    others = (rows[:, None] + 1 + rows) % len(rows)
    pairs = np.stack([rows[:, None] + 0 * others, others], -1)
    state = _bin_centers(pairs.reshape(len(rows), -1) - 1)
    instruction = rows % len(instructions)
    texts = [
        prompts.pi05(instructions[i], values)
        for i, values in zip(instruction.tolist(), state, strict=True)
    ]
    expected = _encode_complete(tokenizer, texts)
    starts = [prompts.pi05_start(text) for text in instructions]
    start = _ids(*_encode_complete(tokenizer, starts, expected[0].shape[1]))
    table = PromptTable(start, numbers, last)
    actual = jax.jit(PromptTable.encode)(table, instruction, state)
    if not all(np.array_equal(a, b) for a, b in zip(actual, expected, strict=True)):
        raise ValueError("the tokenizer merges state values: use the backbone's own tokenizer")


def _bin_centers(bins: np.ndarray) -> np.ndarray:
    """Return the centers of bins, f32; bin 0 starts at -1."""
    return ((2 * bins + 1) / prompts.STATE_BINS - 1).astype(np.float32)


def _suffixes(tokenizer: Tokenizer, texts: Sequence[str], skip: int) -> Ids:
    """Return the ids of prompts without their first `skip` tokens."""
    ids, mask = _encode_complete(tokenizer, texts)
    longest = mask.sum(axis=1).max()
    return _ids(ids[:, skip:longest], mask[:, skip:longest])


def _encode_complete(
    tokenizer: Tokenizer, texts: Sequence[str], min_tokens: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return ids and mask of complete prompts without truncation, at least `min_tokens` wide."""
    # At most one token per byte, plus special tokens such as BOS and EOS.
    upper_bound = max(len(text.encode()) for text in texts) + 8
    return tokenizer.encode(texts, max(upper_bound, min_tokens), complete=True)


def _ids(ids: np.ndarray, mask: np.ndarray) -> Ids:
    return Ids(jnp.asarray(ids), jnp.asarray(mask))
