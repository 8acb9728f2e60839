"""Sentences have their numbers from the results."""

import pytest

from lorasp_jax.study import findings
from lorasp_jax.study.book import Book
from tests.study import synthetic

NAMES = tuple(synthetic.cells())
BOOK = Book(NAMES, synthetic.cells())


@pytest.mark.parametrize("name", ["experts", "edges", "pruned", "shared_directions", "gradients"])
def test_nothing_is_said_before_the_runs(name):
    assert getattr(findings, name)(Book(NAMES, {})) == ""


def test_experts():
    assert findings.experts(BOOK) == "LoRA-MoE has 4 experts of rank 16."


def test_methods_whose_best_rate_is_at_the_edge_are_named():
    rates = {"0.0003": "0011", "0.001": "0111", "0.003": "0001"}
    results = {f"pi0/pilot/full/{rate}": {"outcomes": {"press": o}} for rate, o in rates.items()}
    results |= {
        f"smolvla/pilot/{method}/{rate}": {"outcomes": {"press": "01"[rate == best]}}
        for method, best in (("full", "0.003"), ("dora", "0.0003"), ("lora_sp", "0.001"))
        for rate in rates
    }
    text = findings.edges(Book(NAMES, results))
    assert text.endswith("may lie beyond. On SmolVLA: full fine-tuning; DoRA, r = 64.")


def test_pruning():
    text = findings.pruned(BOOK)
    assert text.startswith(
        "On SmolVLA, it shrinks LoRA-SP's adapters by 38 % and changes success by"
    )
    assert text.endswith("].")


def test_pairs_of_tasks():
    results = dict(synthetic.results())
    for seed in range(3):
        name = f"pi0/multi/lora_sp/s{seed}"
        overlaps = {"pour|press": {"all": [0.9, 0.4]}, "open_pot|press": {"all": [0.5, 0.3]}}
        cosines = {"pour|pour": {"all": 0.5}, "pour|press": {"all": -0.25}}
        measures = {"direction_overlap": overlaps, "gradient_cosine": cosines}
        results[name] = results[name] | {"measures": measures}
    book = Book(tuple(n for n in NAMES if n.startswith("pi0")), results)
    assert findings.shared_directions(book) == (
        "On π0, “pour” and “press” share the most directions (overlap 0.90, by chance 0.40), "
        "“open the pot” and “press” the fewest (0.50, by chance 0.30).\n\n"
    )
    assert findings.gradients(book) == (
        "For LoRA-SP on π0, the cosine is −0.25 between tasks and 0.50 between two batches of one "
        "task.\n\n"
    )
