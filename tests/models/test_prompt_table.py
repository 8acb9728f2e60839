"""Prompts from a table, against the tokenizers themselves."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.models import tokenizer
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.prompt_table import PromptTable

GOLDEN = Path(__file__).parent.parent / "golden" / "tokenizers"


def test_a_row_for_each_instruction():
    config, texts = Pi0Config.nano(), ["press the button", "push it"]
    table = PromptTable.of(tokenizer.Offline(), texts, config)
    found = table.encode(jnp.array([1, 0, 1]))
    wanted = tokenizer.encode([texts[i] for i in (1, 0, 1)], config.max_tokens)
    for mine, theirs in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_a_tokenizer_of_another_model():
    words = tokenizer.load(GOLDEN / "smolvlm_like_tokenizer.json")
    with pytest.raises(ValueError, match=r"token \d+ is beyond the backbone's vocabulary of 320"):
        PromptTable.of(words, ["press the red button"], Pi0Config.nano())
