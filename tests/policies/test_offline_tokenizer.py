"""Vocabulary and encoding of the offline tokenizer."""

import hashlib

import numpy as np
import pytest

import envs
from envs.names import names
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.policies import offline_tokenizer as tokenizer

OFFLINE = tokenizer.Offline()


def test_vocabulary_is_frozen():
    """Shipped weights depend on every id; only reserved entries may change, and so this hash."""
    assert len(tokenizer.VOCABULARY) == tokenizer.VOCABULARY_SIZE
    assert sorted(tokenizer.VOCABULARY.values()) == list(range(tokenizer.VOCABULARY_SIZE))
    digest = hashlib.sha256("\n".join(tokenizer.VOCABULARY).encode()).hexdigest()
    assert digest[:16] == "47bb2a5f5d2d5882"


def test_known_words_are_one_token():
    texts = [
        "put the grape in the basket",
        "Press the RED button",
        "open the lid of the pot",
        "pour the block out of the cup",
    ]
    ids, valid = OFFLINE.encode(texts, 10)
    assert ids.dtype == np.int32
    assert valid.sum(axis=1).tolist() == [len(text.split()) for text in texts]
    assert not ids[~valid].any()
    entries = [list(tokenizer.VOCABULARY)[i] for i in ids[1, :4]]
    assert entries == ["press", "the", "red", "button"]


def test_any_printable_ascii_text_encodes():
    text = "".join(map(chr, range(32, 127)))
    ids, valid = OFFLINE.encode([text, "zyzzyva-42!"], 100)
    assert tokenizer.VOCABULARY["[UNK]"] not in ids[valid]


@pytest.mark.parametrize("text", ["", "press the red button now or never", "drücke 按"])
def test_text_that_cannot_be_encoded_raises(text):
    with pytest.raises(ValueError, match=r"must have 1 to 4 tokens|cannot encode"):
        OFFLINE.encode([text], 4)


def test_text_of_exactly_max_tokens_fits():
    assert OFFLINE.encode(["press the red button"], 4)[1].all()
    with pytest.raises(ValueError, match=r"tokens, got 4: .*--model\.max-tokens 4"):
        OFFLINE.encode(["press the red button"], 3)
    assert [array.shape for array in OFFLINE.encode([], 3)] == [(0, 3), (0, 3)]


def test_spacing_case_and_punctuation():
    texts = ["press the button", "  Press\tTHE\n button ", "press the button."]
    ids, valid = OFFLINE.encode(texts, 6)
    np.testing.assert_array_equal(ids[0], ids[1])
    np.testing.assert_array_equal(ids[0, :3], ids[2, :3])
    assert valid.sum(axis=1).tolist() == [3, 3, 4]


def test_unknown_words_are_split_into_characters():
    entries = list(tokenizer.VOCABULARY)
    ids, valid = OFFLINE.encode(["xylo", "yxlo"], 8)
    assert [entries[i] for i in ids[0][valid[0]]] == ["x", "##y", "##l", "##o"]
    assert [entries[i] for i in ids[1][valid[1]]] == ["y", "##x", "##l", "##o"]


@pytest.mark.parametrize("size", ["nano", "small"])
def test_instructions_of_every_task_have_one_token_per_word(size):
    limit = getattr(Pi0Config, size)().max_tokens
    for name in names("task"):
        texts = envs.make(name).instructions
        ids, valid = OFFLINE.encode(texts, limit)
        assert valid.sum(axis=1).tolist() == [len(text.split()) for text in texts], name
        assert len(np.unique(ids, axis=0)) == len(texts)
