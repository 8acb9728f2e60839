"""The setup of the paper's study beside that of the paper."""

import importlib
from collections.abc import Iterable

from lorasp_jax.config import Config
from lorasp_jax.peft import LoRASP
from studies.paper import naming, published
from studies.paper.book import BACKBONES, NONE, Book, markdown


def setup_table(book: Book, config: Config) -> str:
    """Return the table of the study's setup and the paper's.

    Args:
        book: the results; the sizes of the models are theirs.
        config: that of a run for all tasks.
    """
    optim, images = config.optim, config.image_size
    seeds = len(book.cells(f"{book.backbones[0]}/multi/lora_sp"))
    layers = "all linear layers" if config.targets == (".*",) else ", ".join(config.targets)
    training = f"{optim.steps:,} steps of {optim.batch_size} samples, AdamW"
    episodes = f"{config.evaluation.episodes} episodes per task and seed, {seeds} seeds"
    rows = [
        ["models", _models(book), "π0 of 3.5 billion parameters, and SmolVLA"],
        ["pretraining", "from scratch, the same four tasks on the Panda", "as published"],
        ["robot", "PiPER in MuJoCo", "PiPER"],
        ["cameras", f"side and wrist, {images} x {images} pixels", "side and wrist"],
        [
            "demonstrations per task",
            f"{config.data.episodes}, by a scripted expert",
            "120, teleoperated",
        ],
        ["training, all tasks", training, NONE],
        ["adapted layers", layers, "not stated; the parameter counts fit all linear layers"],
        ["R, size of LoRA-SP's bank", str(book.rank), str(published.RANK)],
        [
            "LoRA-SP's router",
            f"two layers, {LoRASP().hidden_width} hidden units, softplus; our choice",
            "two layers, width not stated; the parameter counts fit "
            f"{LoRASP.paper().hidden_width} hidden units and a softmax",
        ],
        ["evaluation", episodes, "probably 15 episodes per task"],
        ["success", f"state of the simulation, within {_time_limits(config.tasks)} s", NONE],
    ]
    return markdown(["", "here", "in the paper"], rows)


def _models(book: Book) -> str:
    """Return the backbones, and the sizes of those that a finished run of LoRA-SP tells."""
    texts = []
    for backbone in book.backbones:
        cells = naming.flat(book.cells(f"{backbone}/multi/lora_sp"))
        done = next((book.results[name] for name in cells if name in book.results), None)
        size = done and (done["total_parameters"] - done["trainable_parameters"]) / 1e6
        texts.append(BACKBONES[backbone] + (f" of {size:.1f} M parameters" if size else ""))
    return "small versions: " + " and ".join(texts)


def _time_limits(tasks: Iterable[str]) -> str:
    limits = [importlib.import_module(f"envs.tasks.{task}").TASK.time_limit for task in tasks]
    return f"{min(limits):g} to {max(limits):g}"
