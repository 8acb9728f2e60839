"""Offline tokenizer of the project's own base weights: WordPiece with manipulation words.

Other words are split into shorter pieces, down to single characters. So any printable ASCII text
can be encoded if its words have at most 100 characters. The position of an entry is its id, and the
shipped weights depend on it. Never move or remove an entry; a new word replaces the next reserved
entry.
"""

import functools
from collections.abc import Sequence

import numpy as np
import tokenizers
from tokenizers import models, normalizers, pre_tokenizers

from lorasp_jax.models.config import VOCABULARY_SIZE
from lorasp_jax.policies.prompts import pad

_SPECIAL = ("[PAD]", "[UNK]")
_CHARACTERS = tuple(chr(code) for code in range(33, 127) if not chr(code).isupper())
_WORDS = (
    "a an the this that it its and then of",
    "to in into on onto up down from off out with inside over above under by at for near",
    "press push hit tap touch hold click button switch key",
    "pick place put drop grab take lift move carry bring lay leave set get grasp pinch",
    "grape fruit berry basket bowl box bin container tray",
    "open close remove raise uncover pot lid cover pan top handle knob",
    "pour tip empty tilt fill cup mug glass block cube contents",
    "red green blue yellow purple orange black white grey brown dark light small big round",
    "left right front back side middle center table robot arm gripper object please your",
)


def _vocabulary() -> dict[str, int]:
    words = " ".join(_WORDS).split()
    entries = dict.fromkeys((*_SPECIAL, *_CHARACTERS, *(f"##{c}" for c in _CHARACTERS), *words))
    reserved = (f"[RESERVED{i}]" for i in range(VOCABULARY_SIZE - len(entries)))
    return {entry: i for i, entry in enumerate((*entries, *reserved))}


VOCABULARY = _vocabulary()
"""Maps each entry to its id, which must not change."""


@functools.cache
def _tokenizer() -> tokenizers.Tokenizer:
    tokenizer = tokenizers.Tokenizer(models.WordPiece(VOCABULARY, unk_token="[UNK]"))
    tokenizer.normalizer = normalizers.BertNormalizer(lowercase=True)
    tokenizer.pre_tokenizer = pre_tokenizers.BertPreTokenizer()
    return tokenizer


def num_tokens(text: str) -> int:
    """Return the number of tokens of an instruction."""
    return len(_tokenizer().encode(text).ids)


class Offline:
    """The offline tokenizer; see `tokenizer.Tokenizer`."""

    vocabulary = VOCABULARY_SIZE

    def encode(
        self, texts: Sequence[str], max_tokens: int, *, complete: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Encode texts as `Tokenizer.encode` does, padded with id 0; case is ignored.

        `complete` has no effect, because there is no prompt template.

        Raises:
            ValueError: a text is empty, needs more than `max_tokens` tokens, or contains characters
                outside the vocabulary or words of more than 100 characters.
        """
        del complete
        rows = [_tokenizer().encode(text).ids for text in texts]
        for text, row in zip(texts, rows, strict=True):
            if not 0 < len(row) <= max_tokens:
                longest = max(map(len, rows))
                raise ValueError(
                    f"{text!r} must have 1 to {max_tokens} tokens, got {len(row)}"
                    f"{f': shorten it, or train with --model.max-tokens {longest}' * bool(row)}"
                )
            if VOCABULARY["[UNK]"] in row:
                raise ValueError(f"cannot encode {text!r}: only ASCII words up to 100 characters")
        return pad(texts, rows, max_tokens, pad=0)
