"""Compare token ids with those of openpi and transformers, recorded in tests/golden/tokenizers."""

import json
import shutil
import warnings

import huggingface_hub
import numpy as np
import pytest
import sentencepiece

from lorasp_jax.policies import prompts, tokenizer
from tests import GOLDEN

GOLDEN = GOLDEN / "tokenizers"
PROMPTS = json.loads((GOLDEN / "prompts.json").read_text())
FILES = {"paligemma": "paligemma_like.model", "smolvlm": "smolvlm_like_tokenizer.json"}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(("length", "suffix"), [(48, ""), (16, "_len16")])
def test_ids_equal_the_reference(name, length, suffix):
    """Each truncated prompt gives a warning; no PaliGemma prompt exceeds 48 tokens."""
    expected = np.load(GOLDEN / f"{name}_like_ids.npz")
    loaded = tokenizer.load_tokenizer(GOLDEN / FILES[name])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ids, mask = loaded.encode(PROMPTS, length)
    num_cut = {("paligemma", 48): 0, ("paligemma", 16): 4, ("smolvlm", 48): 1, ("smolvlm", 16): 8}
    assert [f"truncated to {length}" in str(w.message) for w in caught] == [True] * num_cut[
        name, length
    ]
    np.testing.assert_array_equal(ids, expected[f"tokens{suffix}"])
    np.testing.assert_array_equal(mask, expected[f"mask{suffix}"])
    assert (ids.dtype, mask.dtype) == (np.int32, bool)
    assert loaded.vocabulary == expected["vocab_size"]


def test_padding_beyond_the_longest_prompt_is_masked():
    expected = np.load(GOLDEN / "smolvlm_like_ids.npz")
    ids, mask = tokenizer.load_tokenizer(GOLDEN / FILES["smolvlm"]).encode(PROMPTS[:4], 48)
    length = expected["tokens_longest"].shape[1]
    np.testing.assert_array_equal(ids[:, :length], expected["tokens_longest"])
    assert not mask[:, length:].any()


def test_a_prompt_begins_with_bos_and_ends_with_a_newline():
    ids, mask = tokenizer.load_tokenizer(GOLDEN / FILES["paligemma"]).encode(["push"], 8)
    assert ids[0][mask[0]][[0, -1]].tolist() == [2, 4]  # BOS, newline


def test_prompt_of_pi05():
    """The state is binned into 256 equal bins of [-1, 1), each including its lower edge."""
    state = np.array([-2.0, -1.0, -0.999, 0.0, 0.5, 0.9999, 1.0, 7.0])
    text = prompts.pi05(" pick_up\nthe cup ", state)
    assert text == "Task: pick up the cup, State: -1 0 0 128 192 255 255 255;\nAction: "
    model = sentencepiece.SentencePieceProcessor(model_file=str(GOLDEN / FILES["paligemma"]))
    ids, mask = tokenizer.load_tokenizer(GOLDEN / FILES["paligemma"]).encode(
        [text], 200, complete=True
    )
    assert ids[0][mask[0]].tolist() == [2, *model.encode(text)]


def test_load_from_folder_hub_and_offline(tmp_path, monkeypatch):
    shutil.copy(GOLDEN / FILES["smolvlm"], tmp_path / "tokenizer.json")
    ids, _ = tokenizer.load_tokenizer(tmp_path).encode(["push"], 4)
    np.testing.assert_array_equal(
        ids, tokenizer.load_tokenizer(GOLDEN / FILES["smolvlm"]).encode(["push"], 4)[0]
    )
    text = ["press the red button"]
    for actual, expected in zip(
        tokenizer.load_tokenizer("").encode(text, 6),
        tokenizer.Offline().encode(text, 6),
        strict=True,
    ):
        np.testing.assert_array_equal(actual, expected)
    requests = []

    def download(name, *, repo_type, allow_patterns, **_):
        requests.append((name, repo_type, allow_patterns))
        return tmp_path

    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    assert tokenizer.load_tokenizer("hf://owner/name").vocabulary
    assert requests == [("owner/name", "model", ["tokenizer.json", "*.model"])]


def test_invalid_files_raise_one_sentence(tmp_path):
    with pytest.raises(ValueError, match=r"tokenizer\.json"):
        tokenizer.load_tokenizer(tmp_path)
    for name in ("a.model", "a.json"):
        (tmp_path / name).write_text("{}")
        with pytest.raises(ValueError, match=name):
            tokenizer.load_tokenizer(tmp_path / name)
    model = bytearray((GOLDEN / FILES["paligemma"]).read_bytes())
    model[43] ^= 1  # removes BOS
    (tmp_path / "b.model").write_bytes(model)
    large = json.loads((GOLDEN / FILES["smolvlm"]).read_text())
    large["model"]["vocab"]["push"] = 2**31
    (tmp_path / "b.json").write_text(json.dumps(large))
    for name in ("b.model", "b.json"):
        with pytest.raises(ValueError, match=name):
            tokenizer.load_tokenizer(tmp_path / name)
    bare = json.loads((GOLDEN / FILES["smolvlm"]).read_text())
    bare["added_tokens"] = []
    bare["model"]["vocab"].pop("<|im_end|>")
    (tmp_path / "tokenizer.json").write_text(json.dumps(bare))
    with pytest.raises(ValueError, match=r"no padding token"):
        tokenizer.load_tokenizer(tmp_path / "tokenizer.json")
