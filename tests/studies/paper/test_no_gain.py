"""Reasons why LoRA-SP does not gain are given if the results support them."""

import pytest

from studies.paper.book import Book
from studies.paper.no_gain import no_gain
from tests.studies.paper import synthetic

TASKS = ("open_pot", "pour", "press", "pick_place")
KINDS = ("full", "lora_r64", "lora_sp", "lora_sp_no_spectral")
RATES = {"full": 80, "lora_r64": 76, "lora_sp": 74, "lora_sp_no_spectral": 75}
PILOTS = {"lora_sp": (60, 72, 40), "lora_r64": (60, 74, 12)}


def outcomes(percent):
    return "1" * percent + "0" * (100 - percent)


def text(multi=RATES, single=None, pilots=PILOTS, backbones=("pi0", "smolvla")):
    """The section from success in %, the same in all tasks and seeds."""
    results = {}
    for backbone in backbones:
        for method, rate in multi.items():
            for seed in range(3):
                cell = {"outcomes": dict.fromkeys(TASKS, outcomes(rate))}
                results[f"{backbone}/multi/{method}/s{seed}"] = cell
        for method, rate in (single or {}).items():
            for task in TASKS:
                for seed in range(3):
                    cell = {"outcomes": {task: outcomes(rate)}}
                    results[f"{backbone}/single/{method}/{task}/s{seed}"] = cell
        for method, rates in pilots.items():
            for name, rate in zip(("0.0003", "0.001", "0.003"), rates, strict=True):
                cell = {"outcomes": dict.fromkeys(TASKS, outcomes(rate))}
                results[f"{backbone}/pilot/{method}/{name}"] = cell
    return no_gain(
        Book(tuple(n for n in synthetic.results() if n.split("/")[0] in backbones), results)
    )


def test_little_is_left():
    assert (
        "- **Little is left to gain.** LoRA with r = 64 reaches, in % of full fine-tuning's "
        "success, 95.0 (72.0) on π0 and 95.0 (69.2) on SmolVLA.\n"
    ) in text()


def test_fewer_directions():
    assert (
        "- **Fewer directions do not raise success.** Success without the spectral loss against "
        "success with it, in %: 75.0 against 74.0 (78.3 against 91.7) on SmolVLA.\n"
    ) in text(backbones=("smolvla",))
    assert "Fewer directions" not in text(RATES | {"lora_sp_no_spectral": 60})


def test_learning_rates():
    assert (
        "At 0.003, in one run each, LoRA-SP leads LoRA by 28.0 points on π0 and 28.0 points on "
        "SmolVLA; at each method's best of three rates, it does not lead.\n"
    ) in text()
    for sp in ((60, 72, 11), (60, 75, 40)):
        assert "A learning rate" not in text(pilots=PILOTS | {"lora_sp": sp})


def test_training_together():
    assert "together" not in text()
    assert (
        "- **Training tasks together did no harm.** One policy for all tasks against one per task, "
        "in %: full fine-tuning 80.0 against 70.0 (83.3 against 86.7) on π0 and 80.0 against 70.0 "
        "(86.7 against 93.3) on SmolVLA.\n"
    ) in text(single={"full": 70})
    harmed = text(single={"full": 70, "lora_r64": 90})
    assert "- **Training tasks together did some harm.**" in harmed
    assert "; LoRA, r = 64 76.0 against 90.0 (60.0 against 93.3) on π0" in harmed


@pytest.mark.parametrize("multi", [{}, RATES | {"lora_sp": 79}, {"lora_sp": 74}])
def test_there_is_no_section_before_the_runs_or_after_a_gain(multi):
    assert text(multi) == ""


def test_only_finished_backbones():
    found = text(backbones=("pi0",))
    assert "SmolVLA" not in found
    assert found.endswith("this study cannot tell.\n\n")
