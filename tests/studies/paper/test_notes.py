"""Sentences beside the verdicts' numbers have their own numbers from the results."""

import re

import numpy as np
import pytest

from studies.paper import notes
from studies.paper.book import Book
from tests.studies.paper import synthetic

NAMES = tuple(synthetic.results())
BOOK = Book(NAMES, synthetic.results())


@pytest.mark.parametrize("name", ["highest_rank", "without_state", "cost_of_cut"])
def test_nothing_is_said_before_the_runs(name):
    missing = {n: r for n, r in synthetic.results().items() if not n.endswith("/s1")}
    assert getattr(notes, name)(Book(NAMES, missing)) == ""


def test_the_highest_rank_is_beside_claim_3():
    assert re.search(
        r"reaches, in %, \d+\.\d \[.*\] \(72\.0\) on π0 and .*\(69\.2\) on SmolVLA",
        notes.highest_rank(BOOK),
    )


def ranks(vision, others, state):
    """Results of LoRA-SP on π0 with three seeds; `others` and `state` are layers of action."""
    action = {"q_proj": [others, others], "state_proj": [state]}
    layers = {"language": {"q_proj": [1.0, 3.0]}, "action": action}
    results = {}
    for seed in range(3):
        shifted = {"fc1": [vision + seed - 1]}
        results[f"pi0/multi/lora_sp/s{seed}"] = {"layer_active_rank": layers | {"vision": shifted}}
    return Book(tuple(results), results)


def test_claim_8_without_one_layer():
    """With the layer, vision is at 12 - (10 + 10 + 52) / 3 = -12, without it at 12 - 10 = 2."""
    half = 4.303 / np.sqrt(3)
    text = notes.without_state(ranks(12.0, 10.0, 52.0))
    assert text.startswith(
        "Claim 8's first number includes one layer of action with a high active rank, the "
        "projection of the robot's state: 52 on π0. Without this layer, the number is "
        f"+2.00 [−{half - 2:.2f}, +{half + 2:.2f}] on π0"
    )
    assert text.endswith(", so claim 8 could not be told on π0.\n")


@pytest.mark.parametrize(("vision", "state"), [(2.0, 52.0), (12.0, 12.0)])
def test_claim_8_is_told_with_and_without_the_layer(vision, state):
    """Either both intervals lie below 0, or none does."""
    assert "could not be told" not in notes.without_state(ranks(vision, 10.0, state))


def test_studies_without_the_layer():
    book = ranks(12.0, 10.0, 52.0)
    for cell in book.results.values():
        cell["layer_active_rank"]["action"].pop("state_proj", None)
    assert notes.without_state(book) == ""


def rates(sp, same, cut):
    """Results with these rates on π0, in tenths."""
    methods = {"lora_sp": sp, "lora_same_rank": same, "lora_cut": cut}
    results = {
        f"pi0/multi/{m}/s0": {"outcomes": {"press": "1" * k + "0" * (10 - k)}}
        for m, k in methods.items()
    }
    return Book(tuple(results), results)


@pytest.mark.parametrize(
    ("tenths", "said"), [((9, 8, 2), True), ((9, 4, 2), False), ((2, 9, 3), False)]
)
def test_what_the_cut_costs(tenths, said):
    text = notes.cost_of_cut(rates(*tenths))
    assert ("trained with the same rank has 80.0 % on π0. The cut is one" in text) == said
    assert bool(text) == said
