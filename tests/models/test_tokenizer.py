import hashlib

import numpy as np
import pytest

from lorasp_jax.models import tokenizer


def test_vocabulary_is_frozen():
    """Shipped weights depend on every id. Only reserved entries may change, and then this hash."""
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
    ids, valid = tokenizer.encode(texts, 10)
    assert ids.dtype == np.int32
    assert valid.sum(axis=1).tolist() == [len(text.split()) for text in texts]
    assert not ids[~valid].any()
    words = [list(tokenizer.VOCABULARY)[i] for i in ids[1, :4]]
    assert words == ["press", "the", "red", "button"]


def test_any_printable_ascii_text_encodes():
    text = "".join(map(chr, range(32, 127)))
    ids, valid = tokenizer.encode([text, "zyzzyva-42!"], 100)
    assert tokenizer.VOCABULARY["[UNK]"] not in ids[valid]


@pytest.mark.parametrize("text", ["", "press the red button now or never", "drücke 按"])
def test_what_cannot_be_encoded_raises(text):
    with pytest.raises(ValueError, match=r"valid are 1 to 4|tokenizer lacks"):
        tokenizer.encode([text], 4)
