"""Token ids of a robot's prompts, tabulated once: no tokenizer runs inside `jax.jit`.

pi0.5's prompt tells the state, "Task: press the button, State: 12 130 7;\\nAction: ". Its ids are
those of the text before the numbers, of each number with the blank before it, and of the last
number with what follows, one after the other. That is so for a tokenizer that never joins a number
with its neighbours; every number beside every other is looked at.
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


class Ids(NamedTuple):
    """Token ids `[N, K]` int32, each row padded on the right, and mask `[N, K]` bool."""

    ids: jax.Array
    mask: jax.Array

    def of(self, rows: jax.Array) -> "Ids":
        """Those of rows `[B, ...]`, flat: `[B, n K]`."""
        return Ids(*(jnp.asarray(a)[rows].reshape(len(rows), -1) for a in self))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PromptTable:
    """Prompts by instruction. A pytree.

    Attributes:
        start: `[P, T]`, one row per instruction: the prompt, or what of it is before the state.
        numbers: by bin, -1 first, where prompts tell the state: a number with its blank.
        last: likewise, the last number with what ends the prompt.
        instructions: P texts.
    """

    start: Ids
    numbers: Ids | None = None
    last: Ids | None = None
    instructions: tuple[str, ...] = field(default=(), metadata={"static": True})

    @classmethod
    def of(
        cls,
        words: Tokenizer,
        instructions: Sequence[str],
        config: BackboneConfig,
        *,
        num_joints: int,
    ) -> "PromptTable":
        """The table that a backbone reads.

        Args:
            words: the tokenizer of the backbone's weights.
            instructions: P texts.
            config: the backbone's; `inputs.prompt_state` says what a prompt is.
            num_joints: J of the robot.

        Raises:
            ValueError: token ids that the backbone does not have, what the tokenizer refuses, or a
                tokenizer that joins a state's numbers.
        """
        if config.inputs.prompt_state:
            table = _with_state(words, instructions, config.max_tokens, num_joints + 1)
        else:
            table = cls(_ids(*words.encode(instructions, config.max_tokens)))
        highest = max(int(leaf.max()) for leaf in jax.tree.leaves(table))
        if highest >= config.vocabulary:
            raise ValueError(
                f"token {highest} is beyond the backbone's vocabulary of {config.vocabulary}: "
                "the tokenizer is another model's."
            )
        return dataclasses.replace(table, instructions=tuple(instructions))

    def chosen(self, instructions: Sequence[str]) -> "PromptTable":
        """The table of these of its instructions, in this order.

        Raises:
            ValueError: one that it does not have.
        """
        if missing := sorted(set(instructions) - set(self.instructions)):
            raise ValueError(f"the policy has no prompt for {missing[0]!r}.")
        rows = np.array([self.instructions.index(text) for text in instructions])
        start = Ids(*(array[rows] for array in self.start))
        return dataclasses.replace(self, start=start, instructions=tuple(instructions))

    def encode(self, instruction: jax.Array, state: jax.Array) -> Ids:
        """The prompts `[B, T]` of instructions in states.

        Args:
            instruction: `[B]` int32 rows.
            state: `[B, J+1]` the robot's normalised numbers; read only where prompts tell them.
        """
        start = self.start.of(instruction)
        if self.numbers is None or self.last is None:
            return start
        rows = jnp.digitize(state, prompts.EDGES)  # bin -1 is row 0
        parts = start, self.numbers.of(rows[:, :-1]), self.last.of(rows[:, -1])
        ids, mask = (jnp.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True))
        order = jnp.argsort(~mask, axis=1, stable=True)[:, : start.ids.shape[1]]  # padding last
        return Ids(*(jnp.take_along_axis(a, order, axis=1) for a in (ids, mask)))


def _with_state(
    words: Tokenizer, instructions: Sequence[str], max_tokens: int, count: int
) -> PromptTable:
    """The table of prompts that tell `count` numbers."""
    starts = [prompts.pi05_start(text) for text in instructions]
    numbers = [f"{starts[0]} {name}" for name in range(-1, prompts.STATE_BINS)]
    last = [number + prompts.PI05_END for number in numbers]
    ids, mask = _encoded(words, starts, max_tokens)
    skip = int(mask[0].sum())
    middle, end = _ends(words, numbers, skip), _ends(words, last, skip)
    _check(words, instructions, middle, end)
    longest = _inside(np.full(count, middle.mask.sum(axis=1).argmax() - 1))
    whole = [prompts.pi05(text, longest) for text in instructions]
    words.encode(whole, max_tokens, complete=True)  # as it does with what is too long
    return PromptTable(_ids(ids[:, :max_tokens], mask[:, :max_tokens]), middle, end)


def _check(words: Tokenizer, instructions: Sequence[str], numbers: Ids, last: Ids) -> None:
    """Raise ValueError unless a table gives what the tokenizer does, whatever the numbers are."""
    names = np.arange(prompts.STATE_BINS + 1)
    # A row for each number: it alternates with all of them, and is the first and the last.
    others = (names[:, None] + 1 + names) % len(names)
    state = _inside(np.stack([names[:, None] + 0 * others, others], -1).reshape(len(names), -1) - 1)
    row = names % len(instructions)
    texts = [prompts.pi05(instructions[i], own) for i, own in zip(row.tolist(), state, strict=True)]
    wanted = _encoded(words, texts)
    starts = [prompts.pi05_start(text) for text in instructions]
    start = _ids(*_encoded(words, starts, wanted[0].shape[1]))
    found = PromptTable(start, numbers, last).encode(jnp.asarray(row), jnp.asarray(state))
    if not all(np.array_equal(a, b) for a, b in zip(found, wanted, strict=True)):
        raise ValueError(
            "the tokenizer does not write a state's numbers one by one, so prompts that tell the "
            "state cannot be tabulated: it is another model's."
        )


def _inside(bins: np.ndarray) -> np.ndarray:
    """A number in the middle of each bin, f32."""
    return ((2 * bins + 1) / prompts.STATE_BINS - 1).astype(np.float32)


def _ends(words: Tokenizer, texts: Sequence[str], skip: int) -> Ids:
    """Ids of prompts without their first `skip` tokens."""
    ids, mask = _encoded(words, texts)
    longest = mask.sum(axis=1).max()
    return _ids(ids[:, skip:longest], mask[:, skip:longest])


def _encoded(
    words: Tokenizer, texts: Sequence[str], least: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Ids and mask of whole prompts, uncut, of at least so many columns."""
    room = max(len(text.encode()) for text in texts) + 8  # a token is a byte or more; BOS, EOS
    return words.encode(texts, max(room, least), complete=True)


def _ids(ids: np.ndarray, mask: np.ndarray) -> Ids:
    return Ids(jnp.asarray(ids), jnp.asarray(mask))
