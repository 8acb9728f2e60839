"""The main result follows the results, on every backbone that is finished."""

import pytest

from lorasp_jax.extras.study import statistics
from studies.paper.book import Book, points
from studies.paper.main_result import main_result
from tests.studies.paper import synthetic

NAMES = tuple(synthetic.results())


def result(results):
    return main_result(Book(NAMES, results))


@pytest.fixture(scope="module")
def no_gain():
    """LoRA-SP has the episodes of LoRA with r = 32, LoRA with r = 64 others."""
    results = dict(synthetic.results())
    for name in NAMES:
        if "/multi/lora_sp/" in name:
            outcomes = results[name.replace("_sp", "_r32")]["outcomes"]
            results[name] = results[name] | {"outcomes": outcomes}
    return results


def test_numbers():
    text, book = result(synthetic.results()), Book(NAMES, synthetic.results())
    assert text.startswith("**Main result: LoRA-SP gains on π0 over LoRA with r = R.**")
    for method, title in (
        ("lora_r64", "with r = R = 64"),
        ("lora_same_rank", "with r = LoRA-SP's mean active rank"),
        ("lora_r32", "with r = R/2 = 32"),
    ):
        pairs = [[f"{b}/multi/{m}" for m in ("lora_sp", method)] for b in ("pi0", "smolvla")]
        pi0, smolvla = (points(statistics.difference(*map(book.outcomes, p))) for p in pairs)
        assert f"\n- {title}: {pi0} on π0 and {smolvla} on SmolVLA" in text


def test_a_gain_is_only_named_if_there_is_one(no_gain):
    text = result(no_gain)
    assert text.startswith("**Main result: LoRA-SP shows no gain over LoRA with r = R.**")
    assert "+0.0 points [+0.0, +0.0] on π0" in text.partition("r = R/2")[2]


def test_the_papers_numbers(no_gain):
    text = result(no_gain)
    assert "; the paper has +23.3 and +31.7, outside these intervals\n" in text
    near = dict(no_gain)
    for seed in range(3):  # 25 points more for LoRA-SP
        for method, ones in (("lora_sp", 24), ("lora_r64", 16)):
            name = f"pi0/multi/{method}/s{seed}"
            outcomes = {t: ("1" * ones).ljust(32, "0") for t in near[name]["outcomes"]}
            near[name] = near[name] | {"outcomes": outcomes}
    assert "; the paper has +23.3 and +31.7, not all outside these intervals\n" in result(near)


def test_the_number_of_parameters(no_gain):
    found = dict(no_gain)
    for name in NAMES:
        if "/multi/lora_s" in name:
            size = {"pi0": 7600, "smolvla": 6960}[name.split("/")[0]]
            size = 1000 if "same_rank" in name else size
            found[name] = found[name] | {"trainable_parameters": size}
    assert "; LoRA-SP trains 7.6 and 7.0 times as many parameters\n" in result(found)


def test_unfinished_backbones_are_left_out():
    some = {n: r for n, r in synthetic.results().items() if n != "pi0/multi/lora_r32/s2"}
    text = result(some)
    assert "π0" not in text
    assert "; the paper has +31.7, outside these intervals\n" in text
    assert result({}) == ""
