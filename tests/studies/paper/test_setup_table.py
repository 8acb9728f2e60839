"""The setup has its numbers from the settings and results."""

import dataclasses

from studies.paper.book import Book
from studies.paper.setup_table import setup_table
from tests.studies.paper import synthetic

CONFIG = synthetic.study()["pi0/pilot/lora_sp/0.001"].config
NAMES = tuple(synthetic.cells())


def test_numbers():
    text = setup_table(Book(NAMES, synthetic.results()), CONFIG).replace("\u00a0", " ")
    assert "| small versions: π0 of 9.9 M parameters and SmolVLA of 9.9 M parameters |" in text
    assert "| 512, by a scripted expert | 120, teleoperated |" in text
    assert "| all linear layers |" in text
    assert "| 64 | 128 |" in text
    assert "two layers, 32 hidden units, softplus; our choice | two layers, width" in text
    assert "the parameter counts fit 4 hidden units and a softmax |" in text
    assert "| 256 episodes per task and seed, 3 seeds |" in text
    assert "within 8 to 20 s" in text


def test_before_the_first_run():
    config = dataclasses.replace(CONFIG, targets=("^action/",), image_size=96)
    text = setup_table(Book(NAMES, {}), config)
    assert "| small versions: π0 and SmolVLA |" in text
    assert "| ^action/ |" in text
    assert "96 x 96 pixels" in text
