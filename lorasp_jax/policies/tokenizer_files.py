"""Tokenizers of the published language models, read from their files.

Each kind of file goes with one way to write a prompt: openpi reads PaliGemma's SentencePiece model,
LeRobot reads files of the library `tokenizers`, for pi0 and SmolVLA alike.
"""

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import sentencepiece
import tokenizers

from lorasp_jax.policies import prompts

PAD_TOKENS = ("<pad>", "<|im_end|>")
"""What fills up a prompt: PaliGemma's token, SmolVLM2's."""


class SentencePiece:
    """A SentencePiece model, as openpi uses it (models/tokenizer.py at 15a9616a).

    Raises:
        ValueError: no such model.
    """

    def __init__(self, file: Path) -> None:
        try:
            self._model = sentencepiece.SentencePieceProcessor(model_file=str(file))
            self._model.encode("", add_bos=True)  # as long as that works, every text does
        except (OSError, RuntimeError, ValueError) as error:
            raise ValueError(f"{file} is no SentencePiece model of PaliGemma's kind.") from error

    @property
    def vocabulary(self) -> int:
        """Number of tokens."""
        return self._model.vocab_size()

    def encode(
        self, texts: Sequence[str], max_tokens: int, *, complete: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """BOS, the cleaned text, a newline; see `tokenizer.Tokenizer`."""
        rows = [
            self._model.encode(t if complete else prompts.openpi(t), add_bos=True) for t in texts
        ]
        if not complete:
            # Apart, as the answer's first token: it must not join the text's last piece.
            newline = self._model.encode("\n")
            rows = [row + newline for row in rows]
        return _padded(texts, rows, max_tokens, pad=0)


class TokenizersFile:
    """A tokenizer.json of Hugging Face, as LeRobot uses it.

    Raises:
        ValueError: no such file, or none of `PAD_TOKENS` in it.
    """

    def __init__(self, file: Path) -> None:
        try:
            self._model = tokenizers.Tokenizer.from_file(str(file))
        except Exception as error:  # the library raises nothing more special
            raise ValueError(f"{file} is no file of the library tokenizers.") from error
        self._model.no_truncation()
        self._model.no_padding()
        pads = [self._model.token_to_id(token) for token in PAD_TOKENS]
        found = [pad for pad in pads if pad is not None]
        if not found:
            raise ValueError(
                f"{file} has no token to pad with, which is {' or '.join(PAD_TOKENS)}."
            )
        self._pad = found[0]
        self.vocabulary: int = 1 + max(self._model.get_vocab().values())
        """Number of tokens, those included that the file leaves out."""
        if self.vocabulary > np.iinfo(np.int32).max:
            raise ValueError(f"{file} has a token of number {self.vocabulary - 1}.")

    def encode(
        self, texts: Sequence[str], max_tokens: int, *, complete: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """The text with a newline at its end, and what the file itself puts around it, as BOS.

        See `tokenizer.Tokenizer`.
        """
        written = [text if complete else prompts.lerobot(text) for text in texts]
        rows = [encoding.ids for encoding in self._model.encode_batch(written)]
        return _padded(texts, rows, max_tokens, pad=self._pad)


def _padded(
    texts: Sequence[str], rows: Sequence[Sequence[int]], max_tokens: int, pad: int
) -> tuple[np.ndarray, np.ndarray]:
    """ids `[P, T]` int32 and valid `[P, T]` bool of rows, cut or padded on the right."""
    ids = np.full((len(rows), max_tokens), pad, np.int32)
    valid = np.zeros((len(rows), max_tokens), bool)
    for i, (text, row) in enumerate(zip(texts, rows, strict=True)):
        if len(row) > max_tokens:
            warnings.warn(
                f"{text!r} has {len(row)} tokens and is cut to {max_tokens}.", stacklevel=3
            )
        ids[i, : len(row)] = row[:max_tokens]
        valid[i, : len(row)] = True
    return ids, valid
