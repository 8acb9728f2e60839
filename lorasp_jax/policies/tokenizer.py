"""Define the tokenizer interface and load tokenizers from a path.

Implementations: `offline_tokenizer` for the project's own base weights, `pretrained_tokenizers` for
published language models.
"""

import os
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from lorasp_jax.policies.offline_tokenizer import Offline

__all__ = ["Offline", "Tokenizer", "load_tokenizer"]


class Tokenizer(Protocol):
    """Encodes instructions as a backbone's token ids."""

    @property
    def vocabulary(self) -> int:
        """Number of tokens; a backbone's embedding table must have at least as many rows."""
        ...

    def encode(
        self, texts: Sequence[str], max_tokens: int, *, complete: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Encode P instructions, padded on the right.

        Instructions of more than T tokens are truncated with a warning; the offline tokenizer
        raises ValueError instead.

        Args:
            texts: instructions.
            max_tokens: T.
            complete: True if the texts are complete prompts, such as those of `prompts.pi05`, to be
                encoded unchanged.

        Returns:
            ids `[P, T]` int32, valid `[P, T]` bool.
        """
        ...


def load_tokenizer(where: str | os.PathLike[str]) -> Tokenizer:
    """Load a tokenizer from a file.

    Args:
        where: a SentencePiece `.model`, a `tokenizer.json`, or a folder that contains one of them,
            given as a local path, Hub repository or bucket URL; see `hub.local`. An empty string
            selects the offline tokenizer.

    Raises:
        ValueError: the path does not exist or contains no valid tokenizer.
    """
    from lorasp_jax.base import hub
    from lorasp_jax.base.files import TEXT_BYTES, as_value_error, check_regular
    from lorasp_jax.policies.pretrained_tokenizers import SentencePiece, TokenizersFile

    if not os.fspath(where):
        return Offline()
    path = hub.local(where, only=["tokenizer.json", "*.model"])
    files = [path] if path.is_file() else [*path.glob("tokenizer.json"), *path.glob("*.model")]
    for file in files:
        if file.suffix in (".json", ".model"):
            with as_value_error(file):
                if check_regular(file).stat().st_size > TEXT_BYTES:
                    raise ValueError(f"it is larger than {TEXT_BYTES} bytes")
            return (TokenizersFile if file.suffix == ".json" else SentencePiece)(file)
    raise ValueError(f"{where} contains neither tokenizer.json nor a SentencePiece .model file")
