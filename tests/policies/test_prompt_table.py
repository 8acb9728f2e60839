"""Compare prompts assembled from a table with those of the tokenizers."""

import dataclasses
import functools
import json

import jax
import numpy as np
import pytest

from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.policies import prompts, tokenizer
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.prompts import pad
from tests import GOLDEN

GOLDEN = GOLDEN / "tokenizers"
SMOLVLM = GOLDEN / "smolvlm_like_tokenizer.json"
TEXTS = ["press the button", " pick_up\nthe cup "]
PI05 = Pi0Config.nano_pi05()
encode = jax.jit(PromptTable.encode)


def test_one_row_per_instruction():
    config = Pi0Config.nano()
    table = PromptTable.of(tokenizer.Offline(), TEXTS, config, num_joints=6)
    actual = encode(table, np.array([1, 0, 1]), np.zeros((3, 7)))
    expected = tokenizer.Offline().encode([TEXTS[i] for i in (1, 0, 1)], config.max_tokens)
    for a, b in zip(actual, expected, strict=True):
        np.testing.assert_array_equal(a, b)


def test_rows_of_instructions():
    table = PromptTable.of(tokenizer.Offline(), TEXTS[:1], Pi0Config.nano(), num_joints=6)
    assert table.rows(TEXTS[:1] * 2).tolist() == [0, 0]
    with pytest.raises(ValueError, match="'close the lid'"):
        table.rows([TEXTS[0], "close the lid"])


def test_some_instructions_have_the_table_that_they_would_have_alone(few_bins):
    of = functools.partial(PromptTable.of, tokenizer.Offline(), num_joints=1)
    for config in (Pi0Config.nano(), PI05):
        some, alone = of(instructions=TEXTS, config=config).only(TEXTS[1:]), of(TEXTS[1:], config)
        assert some.instructions == alone.instructions
        jax.tree.map(np.testing.assert_array_equal, some, alone)


@pytest.mark.parametrize(
    ("file", "numbers"),
    [
        ("paligemma_like.model", 7),
        (SMOLVLM.name, 7),
        pytest.param("", 7, marks=pytest.mark.slow),
        ("", 1),
    ],
)
def test_prompts_with_state_equal_the_tokenizers(file, numbers):
    """States include the bin edges and values outside [-1, 1]."""
    words = tokenizer.load_tokenizer(file and GOLDEN / file)
    config = dataclasses.replace(PI05, max_tokens=100, vocabulary=words.vocabulary)
    table = PromptTable.of(words, TEXTS, config, num_joints=numbers - 1)
    rng = np.random.default_rng(1)
    state = rng.normal(size=(300, numbers)).astype(np.float32)
    state[:256, 0] = np.arange(256) / 128 - 1
    state[256], state[257] = -3, 3
    row = rng.integers(0, 2, 300)
    texts = [prompts.pi05(TEXTS[i], values) for i, values in zip(row, state, strict=True)]
    actual = encode(table, row, state)
    for a, b in zip(actual, words.encode(texts, 100, complete=True), strict=True):
        np.testing.assert_array_equal(a, b)


def test_long_prompts_are_truncated_like_the_tokenizer(few_bins):
    words = tokenizer.load_tokenizer(SMOLVLM)
    config = dataclasses.replace(PI05, max_tokens=30, vocabulary=words.vocabulary)
    with pytest.warns(UserWarning, match="truncated to 30"):
        table = PromptTable.of(words, TEXTS, config, num_joints=6)
    state = np.full(7, 0.9, np.float32)
    with pytest.warns(UserWarning, match="truncated to 30"):
        expected = words.encode([prompts.pi05(TEXTS[0], state)], 30, complete=True)
    actual = encode(table, np.array([0]), state[None])
    assert actual.mask.all()
    np.testing.assert_array_equal(actual.ids, expected[0])
    with pytest.raises(ValueError, match="30 tokens"):
        PromptTable.of(tokenizer.Offline(), TEXTS, config, num_joints=6)


@pytest.mark.parametrize("merged", [" 7 8", " 9 9", "5 15;"])
def test_tokenizers_that_merge_numbers_are_rejected(few_bins, merged, tmp_path):
    fields = json.loads(SMOLVLM.read_text())
    flags = dict.fromkeys(("single_word", "lstrip", "rstrip", "normalized", "special"), False)
    fields["added_tokens"].append({"id": 400, "content": merged, **flags})
    (tmp_path / "tokenizer.json").write_text(json.dumps(fields))
    config = dataclasses.replace(PI05, max_tokens=100, vocabulary=401)
    with pytest.raises(ValueError, match="merges"):
        PromptTable.of(tokenizer.load_tokenizer(tmp_path), TEXTS, config, num_joints=6)


@pytest.mark.parametrize("config", [Pi0Config.nano(), dataclasses.replace(PI05, max_tokens=100)])
def test_tokenizer_of_a_different_model(few_bins, config):
    words = tokenizer.load_tokenizer(SMOLVLM)
    with pytest.raises(ValueError, match="vocabulary 320"):
        PromptTable.of(words, ["press the red button"], config, num_joints=6)


class Letters:
    """A tokenizer of letters that cuts what is too long."""

    vocabulary = 128

    def encode(self, texts, max_tokens, *, complete=False):
        rows = [[ord(letter) for letter in text][:max_tokens] for text in texts]
        return pad(texts, rows, max_tokens, pad=0)


@pytest.mark.filterwarnings("ignore:.*truncated:UserWarning")
def test_endings_follow_every_instruction_and_must_fit():
    """A policy is asked to do what follows the first."""
    config = dataclasses.replace(Pi0Config.dummy(), max_tokens=6)
    table = PromptTable.of(Letters(), ["lift", "go"], config, num_joints=6, endings=("+", "-", ""))
    said = ["".join(map(chr, row[row > 0])) for row in np.asarray(table.start.ids)]
    assert said == ["lift+", "go+", "lift-", "go-", "lift", "go"]
    assert table.rows(["go"]).tolist() == [1]
    plain = np.asarray(table.plain().start.ids)[:2]
    assert ["".join(map(chr, row[row > 0])) for row in plain] == ["lift", "go"]
    asked = table.with_instructions(Letters(), ["put"])
    assert "".join(map(chr, np.asarray(asked.start.ids[0])[:4])) == "put+"
    assert asked.endings == ("+",)  # a row for each
    said = ["".join(map(chr, row[row > 0])) for row in np.asarray(table.only(["go"]).start.ids)]
    assert (said, table.only(["go"]).instructions) == (["go+", "go-", "go"], ("go",))
    with pytest.raises(ValueError, match=r"'release' leaves no room for '[+]' in 6 tokens"):
        PromptTable.of(Letters(), ["release"], config, num_joints=6, endings=("+", "-", ""))
