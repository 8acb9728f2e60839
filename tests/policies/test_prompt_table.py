"""Prompts from a table, against the tokenizers themselves."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.policies import offline_tokenizer, prompts, tokenizer
from lorasp_jax.policies.prompt_table import PromptTable
from tests import GOLDEN

GOLDEN = GOLDEN / "tokenizers"
SMOLVLM = GOLDEN / "smolvlm_like_tokenizer.json"
TEXTS = ["press the button", " pick_up\nthe cup "]
PI05 = Pi0Config.nano_pi05()


def test_a_row_for_each_instruction():
    config = Pi0Config.nano()
    table = PromptTable.of(tokenizer.Offline(), TEXTS, config, num_joints=6)
    found = table.encode(jnp.array([1, 0, 1]), jnp.zeros((3, 7)))
    wanted = offline_tokenizer.encode([TEXTS[i] for i in (1, 0, 1)], config.max_tokens)
    for mine, theirs in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_some_of_its_instructions():
    """As an environment numbers its own."""
    words, rows = tokenizer.load_tokenizer(SMOLVLM), jnp.arange(2)
    config = dataclasses.replace(Pi0Config.nano(), max_tokens=20, vocabulary=words.vocabulary)
    table = PromptTable.of(words, ["open the lid", *TEXTS], config, num_joints=6)
    own = PromptTable.of(words, TEXTS[::-1], config, num_joints=6)
    state = jnp.zeros((2, 7))
    jax.tree.map(np.testing.assert_array_equal, table.chosen(TEXTS[::-1]), own)
    assert (own.encode(rows, state).ids != table.encode(rows, state).ids).any()
    with pytest.raises(ValueError, match="the policy has no prompt for 'close the lid'"):
        table.chosen([TEXTS[0], "close the lid"])


@pytest.mark.parametrize("words", ["paligemma_like.model", SMOLVLM.name, ""])
@pytest.mark.parametrize("numbers", [1, 7])
def test_prompts_with_a_state_are_the_tokenizers(words, numbers):
    """Also on the edges of bins, and beyond them."""
    words = tokenizer.load_tokenizer(words and GOLDEN / words)
    config = dataclasses.replace(PI05, max_tokens=100, vocabulary=words.vocabulary)
    table = PromptTable.of(words, TEXTS, config, num_joints=numbers - 1)
    rng = np.random.default_rng(1)
    state = rng.normal(size=(300, numbers)).astype(np.float32)
    state[:256, 0] = np.arange(256) / 128 - 1
    state[256], state[257] = -3, 3
    row = rng.integers(0, 2, 300)
    texts = [prompts.pi05(TEXTS[i], own) for i, own in zip(row, state, strict=True)]
    found = jax.jit(PromptTable.encode)(table, jnp.asarray(row), jnp.asarray(state))
    for mine, theirs in zip(found, words.encode(texts, 100, complete=True), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_what_is_too_long_is_cut_as_the_tokenizer_cuts_it():
    words = tokenizer.load_tokenizer(SMOLVLM)
    config = dataclasses.replace(PI05, max_tokens=35, vocabulary=words.vocabulary)
    with pytest.warns(UserWarning, match="truncated to 35"):
        table = PromptTable.of(words, TEXTS, config, num_joints=6)
    state = np.full(7, 0.9, np.float32)
    with pytest.warns(UserWarning, match="truncated to 35"):
        wanted = words.encode([prompts.pi05(TEXTS[0], state)], 35, complete=True)
    found = table.encode(jnp.array([0]), jnp.asarray(state[None]))
    assert found.mask.all()
    np.testing.assert_array_equal(found.ids, wanted[0])
    with pytest.raises(ValueError, match="valid are 1 to 35"):
        PromptTable.of(tokenizer.Offline(), TEXTS, config, num_joints=6)


@pytest.mark.parametrize("joined", [" 7 8", " 9 9", "5 255;"])
def test_a_tokenizer_that_joins_numbers_is_refused(joined, tmp_path):
    """One that has a token for two numbers, which no table of single ones gives."""
    fields = json.loads(SMOLVLM.read_text())
    flags = dict.fromkeys(("single_word", "lstrip", "rstrip", "normalized", "special"), False)
    fields["added_tokens"].append({"id": 400, "content": joined, **flags})
    (tmp_path / "tokenizer.json").write_text(json.dumps(fields))
    config = dataclasses.replace(PI05, max_tokens=100, vocabulary=401)
    with pytest.raises(ValueError, match="does not write a state's numbers one by one"):
        PromptTable.of(tokenizer.load_tokenizer(tmp_path), TEXTS, config, num_joints=6)


@pytest.mark.parametrize("config", [Pi0Config.nano(), dataclasses.replace(PI05, max_tokens=100)])
def test_a_tokenizer_of_another_model(config):
    words = tokenizer.load_tokenizer(SMOLVLM)
    with pytest.raises(ValueError, match=r"token \d+ is beyond the backbone's vocabulary of 320"):
        PromptTable.of(words, ["press the red button"], config, num_joints=6)
