"""Tokenizers of published language models, loaded from their files.

The file format implies the prompt template: openpi reads PaliGemma's SentencePiece model, and
LeRobot reads Hugging Face tokenizer files for both pi0 and SmolVLA.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import sentencepiece
import tokenizers

from lorasp_jax.policies import prompts

PAD_TOKENS = ("<pad>", "<|im_end|>")
"""Padding tokens of PaliGemma and SmolVLM2."""


class SentencePiece:
    """A SentencePiece model with openpi's prompt (models/tokenizer.py at 15a9616a).

    Raises:
        ValueError: the file is not a SentencePiece model with BOS.
    """

    def __init__(self, file: Path) -> None:
        try:
            self._model = sentencepiece.SentencePieceProcessor(model_file=str(file))
            self._model.encode("", add_bos=True)  # raises if there is no BOS
        except (OSError, RuntimeError, ValueError) as error:
            raise ValueError(f"{file} is not a SentencePiece model like PaliGemma's") from error

    @property
    def vocabulary(self) -> int:
        """Number of tokens."""
        return self._model.vocab_size()

    def encode(
        self, texts: Sequence[str], max_tokens: int, *, complete: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Encode each text as BOS, the cleaned text and a newline; see `tokenizer.Tokenizer`."""
        rows = [
            self._model.encode(t if complete else prompts.openpi(t), add_bos=True) for t in texts
        ]
        if not complete:
            # Encoded separately, so that the newline never merges with the end of the text.
            newline = self._model.encode("\n")
            rows = [row + newline for row in rows]
        return prompts.pad(texts, rows, max_tokens, pad=0)


class TokenizersFile:
    """A Hugging Face tokenizer.json with LeRobot's prompt.

    Raises:
        ValueError: the file is invalid or has none of `PAD_TOKENS`.
    """

    def __init__(self, file: Path) -> None:
        try:
            self._model = tokenizers.Tokenizer.from_file(str(file))
        except Exception as error:  # tokenizers raises bare Exception
            raise ValueError(f"{file} is not a Hugging Face tokenizer file") from error
        self._model.no_truncation()
        self._model.no_padding()
        pads = [self._model.token_to_id(token) for token in PAD_TOKENS]
        pads = [pad for pad in pads if pad is not None]
        if not pads:
            raise ValueError(f"{file} has no padding token ({' or '.join(PAD_TOKENS)})")
        self._pad = pads[0]
        self.vocabulary: int = 1 + max(self._model.get_vocab().values())
        """Largest token id + 1; the file may skip ids."""
        if self.vocabulary > np.iinfo(np.int32).max:
            raise ValueError(f"{file} has token id {self.vocabulary - 1}, which exceeds int32")

    def encode(
        self, texts: Sequence[str], max_tokens: int, *, complete: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Encode each text with a final newline and the file's special tokens, such as BOS.

        See `tokenizer.Tokenizer`.
        """
        full_prompts = [text if complete else prompts.lerobot(text) for text in texts]
        rows = [encoding.ids for encoding in self._model.encode_batch(full_prompts)]
        return prompts.pad(texts, rows, max_tokens, pad=self._pad)
