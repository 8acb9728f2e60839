"""Token ids of a robot's instructions, tabulated once: no tokenizer runs inside `jax.jit`."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.tokenizer import Tokenizer


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PromptTable:
    """Prompts by instruction. A pytree.

    Attributes:
        tokens: `[P, T]` int32, one row per instruction.
        token_mask: `[P, T]` bool.
    """

    tokens: jax.Array
    token_mask: jax.Array

    @classmethod
    def of(
        cls, words: Tokenizer, instructions: Sequence[str], config: BackboneConfig
    ) -> "PromptTable":
        """The table that a backbone reads.

        Args:
            words: the tokenizer of the backbone's weights.
            instructions: P texts.
            config: the backbone's, for its length of prompts and its vocabulary.

        Raises:
            ValueError: token ids that the backbone does not have, or what the tokenizer refuses.
        """
        ids, mask = words.encode(instructions, config.max_tokens)
        if ids.max(initial=0) >= config.vocabulary:
            raise ValueError(
                f"token {ids.max()} is beyond the backbone's vocabulary of {config.vocabulary}: "
                "the tokenizer is another model's."
            )
        return cls(jnp.asarray(ids), jnp.asarray(mask))

    def encode(self, instruction: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Ids `[B, T]` int32 and mask `[B, T]` bool of rows `[B]` int32."""
        return jnp.asarray(self.tokens)[instruction], jnp.asarray(self.token_mask)[instruction]
