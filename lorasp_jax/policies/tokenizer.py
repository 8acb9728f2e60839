"""Text to token ids. `load_tokenizer` reads the published language models' tokenizers.

The one written here is a tiny offline tokenizer for the project's own base weights: WordPiece over
manipulation words. Words outside the list fall into characters, so every printable ASCII text
encodes. The position of an entry is its id and shipped weights depend on it: entries are never
moved or removed, new words take the place of the next reserved one.
"""

import functools
import os
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import tokenizers
from tokenizers import models, normalizers, pre_tokenizers

from lorasp_jax.models.config import VOCABULARY_SIZE

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
    known = dict.fromkeys((*_SPECIAL, *_CHARACTERS, *(f"##{c}" for c in _CHARACTERS), *words))
    reserved = (f"[RESERVED{i}]" for i in range(VOCABULARY_SIZE - len(known)))
    return {entry: i for i, entry in enumerate((*known, *reserved))}


VOCABULARY = _vocabulary()
"""Id of every entry; frozen."""


@functools.cache
def _tokenizer() -> tokenizers.Tokenizer:
    tokenizer = tokenizers.Tokenizer(models.WordPiece(VOCABULARY, unk_token="[UNK]"))
    tokenizer.normalizer = normalizers.BertNormalizer(lowercase=True)
    tokenizer.pre_tokenizer = pre_tokenizers.BertPreTokenizer()
    return tokenizer


class Tokenizer(Protocol):
    """What turns instructions into a backbone's token ids."""

    @property
    def vocabulary(self) -> int:
        """Number of tokens; a backbone's embedding table must have as many rows or more."""
        ...

    def encode(
        self, texts: Sequence[str], max_tokens: int, *, complete: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Token ids of P instructions, padded on the right.

        One that is too long is cut, with a warning; the offline tokenizer raises ValueError.

        Args:
            texts: instructions.
            max_tokens: T.
            complete: the texts are whole prompts, as `prompts.pi05` writes, and stay as they are.

        Returns:
            ids `[P, T]` int32, valid `[P, T]` bool.
        """
        ...


def load_tokenizer(where: str | os.PathLike[str]) -> Tokenizer:
    """A tokenizer from its file.

    Args:
        where: a SentencePiece `.model`, a `tokenizer.json`, or a folder with one of them, in a
            place that `hub.local` knows: on this machine, on the hub, in a bucket. Empty: the
            offline tokenizer.

    Raises:
        ValueError: there is no such place, or no tokenizer in it.
    """
    from envs.datasets.files import TEXT_BYTES
    from lorasp_jax.policies.tokenizer_files import SentencePiece, TokenizersFile
    from lorasp_jax.storage import hub

    if not os.fspath(where):
        return Offline()
    path = hub.local(where, only=["tokenizer.json", "*.model"])
    files = [path] if path.is_file() else [*path.glob("tokenizer.json"), *path.glob("*.model")]
    for file in files:
        if file.is_file() and file.stat().st_size > TEXT_BYTES:
            raise ValueError(f"{file} is no tokenizer: it has more than {TEXT_BYTES} bytes.")
        if file.is_file() and file.suffix in (".json", ".model"):
            return (TokenizersFile if file.suffix == ".json" else SentencePiece)(file)
    raise ValueError(f"{where} holds no tokenizer.json and no .model of SentencePiece.")


class Offline:
    """The tokenizer of this file."""

    vocabulary = VOCABULARY_SIZE

    def encode(
        self, texts: Sequence[str], max_tokens: int, *, complete: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """As `tokenizer.encode`; a prompt is the text itself."""
        del complete
        return encode(texts, max_tokens)


def encode(texts: Sequence[str], max_tokens: int) -> tuple[np.ndarray, np.ndarray]:
    """Token ids of P texts from the offline tokenizer, padded on the right with id 0.

    Args:
        texts: instructions; case does not matter.
        max_tokens: T.

    Returns:
        ids `[P, T]` int32, valid `[P, T]` bool.

    Raises:
        ValueError: a text is empty, needs more than `max_tokens`, or has characters outside ASCII.
    """
    ids = np.zeros((len(texts), max_tokens), np.int32)
    valid = np.zeros((len(texts), max_tokens), bool)
    for row, text in enumerate(texts):
        found = _tokenizer().encode(text).ids
        if not 0 < len(found) <= max_tokens:
            raise ValueError(f"{text!r} has {len(found)} tokens; valid are 1 to {max_tokens}.")
        if VOCABULARY["[UNK]"] in found:
            raise ValueError(f"{text!r} has a character or word that the tiny tokenizer lacks.")
        ids[row, : len(found)] = found
        valid[row, : len(found)] = True
    return ids, valid
