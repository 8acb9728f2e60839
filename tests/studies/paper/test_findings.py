"""Sentences have their numbers from the results."""

import pytest

from studies.paper import findings
from studies.paper.book import Book
from tests.studies.paper import synthetic

NAMES = tuple(synthetic.cells())
BOOK = Book(NAMES, synthetic.cells())


@pytest.mark.parametrize(
    "name",
    [
        *("experts", "edges", "pruned", "shared_directions", "gradients"),
        *("easy_tasks", "harder_scene", "adapter_sizes"),
    ],
)
def test_nothing_is_said_before_the_runs(name):
    assert getattr(findings, name)(Book(NAMES, {})) == ""


def changed(prefix, **fields):
    """Results in which all cells of some methods have other content."""
    results = dict(synthetic.results())
    for name in NAMES:
        if name.startswith(prefix):
            results[name] = results[name] | fields
    return Book(NAMES, results)


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
        "On SmolVLA, pruning removes 38 % of LoRA-SP's adapters although a token uses 20 of 64 "
        "directions. Success changes by "
    )
    assert text.endswith("].")
    measures = {"smaller": {"bytes": [100, 97]}}
    text = findings.pruned(changed("smolvla/multi/lora_sp_pruned", measures=measures))
    assert "removes only 3 % of" in text
    assert "64 directions, because nearly every direction serves some token. Success" in text
    assert text.endswith("A low active rank is not a small adapter.")


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
    assert findings.gradients(book).startswith(
        "Mean cosine between two tasks against that between two batches of one: LoRA-SP −0.25 "
        "against 0.50 on π0; full fine-tuning "
    )


def test_easy_tasks():
    assert findings.easy_tasks(BOOK) == ""
    results = dict(synthetic.results())
    for name in NAMES:
        if "/multi/" in name and "lora_cut" not in name:
            outcomes = {"open_pot": "1" * 99 + "0", "pour": "1" * 100, "press": "1" * 50 + "0" * 50}
            results[name] = results[name] | {"outcomes": outcomes | {"pick_place": "0" * 100}}
    assert findings.easy_tasks(Book(NAMES, results)) == (
        "- In “open the pot” and “pour”, every trained method of Table I has 99 to 100 % success. "
        "Differences come mostly from the others, so the mean over tasks about halves them.\n"
    )
    name = "smolvla/multi/dora/s0"
    results[name] = results[name] | {
        "outcomes": results[name]["outcomes"] | {"pour": "1" * 90 + "0" * 10}
    }
    text = findings.easy_tasks(Book(NAMES, results))
    assert text.startswith("- In “open the pot”, ")
    assert text.endswith("the others.\n")


def test_the_harder_scene():
    tasks = ("open_pot", "pour", "press", "pick_place")
    book = changed(("pi0/panda", "smolvla/panda"), outcomes=dict.fromkeys(tasks, "1000" * 8))
    rates = [100 * book.outcomes(f"{b}/multi/full").mean() for b in ("pi0", "smolvla")]
    assert findings.harder_scene(book).startswith(
        "The Panda's new scene is harder than PiPER's: after training, "
        f"25.0 % against {rates[0]:.1f} % on π0 and 25.0 % against {rates[1]:.1f} % on SmolVLA. A "
    )
    easier = changed("smolvla/panda", outcomes=dict.fromkeys(tasks, "1111" * 8))
    assert findings.harder_scene(easier) == ""


def test_adapters_are_not_small():
    assert findings.adapter_sizes(BOOK) == (
        "At this size, adapters are not small: in % of the base's parameters, LoRA with r = R has "
        "58 (10 in the paper) on π0 and 58 (20 in the paper) on SmolVLA."
    )
