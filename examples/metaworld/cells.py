"""The policies that docs/metaworld.md compares, and the commands that make and judge them."""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from examples.metaworld.tasks import SETS

SEEDS = (0, 1, 2)
METHODS = {
    "lora_sp": ("--method", "lora_sp", "--peft.rank", "64"),
    "lora_r64": ("--method", "lora", "--peft.rank", "64"),
    "lora_r16": ("--method", "lora", "--peft.rank", "16"),
    "ada_lora": ("--method", "ada_lora", "--peft.rank", "64", "--peft.target-rank", "16"),
    "full": ("--method", "full"),
}
"""Name of a method -> its options of train.py."""
RATES = {
    "pi0": {"full": 3e-4, "ada_lora": 3e-3},
    "smolvla": {"ada_lora": 3e-3},
}
"""Learning rates other than 1e-3: those that docs/study.md found best, on other tasks."""
STEPS = {"mt50": 10_000, "ml45": 10_000, "ml5": 2_000}


@dataclass(frozen=True)
class Cell:
    """One policy.

    Attributes:
        backbone: pi0 or smolvla.
        tasks: what it learns, a key of `SETS`.
        method: a key of `METHODS`.
        seed: its seed.
    """

    backbone: str
    tasks: str
    method: str
    seed: int

    @property
    def name(self) -> str:
        """Name of its run, and of its entry in the results."""
        return f"metaworld_{self.backbone}_{self.tasks}_{self.method}_s{self.seed}"

    @property
    def run(self) -> Path:
        """Folder of its run."""
        return Path("runs") / self.name

    @property
    def base(self) -> "Cell | None":
        """The fully fine-tuned policy that it starts from; None: the bundled base."""
        return Cell(self.backbone, "ml45", "full", 0) if self.tasks == "ml5" else None

    def train(self, data: Path, more: Sequence[str] = ()) -> list[str]:
        """Return the command that trains it on demonstrations in `data`, or resumes its run."""
        rate = RATES[self.backbone].get(self.method, 1e-3)
        options = {
            "name": self.name,
            "seed": self.seed,
            "data.source": data / self.tasks,
            "model.backbone": self.backbone,
            "optim.steps": STEPS[self.tasks],
            "optim.learning-rate": rate,
        }
        if self.base:
            options["model.checkpoint"] = self.base.run / "base"
        pairs = [text for key, value in options.items() for text in (f"--{key}", str(value))]
        start = [sys.executable, "train.py", "--config", "configs/metaworld.py", "--resume", "auto"]
        return [*start, *METHODS[self.method], *pairs, *more]

    def serve(self, port: int) -> list[str]:
        """Return the command that serves it."""
        command = [sys.executable, "-m", "lorasp_jax.serving", str(self.run)]
        return [*command, "--port", str(port), "--seed", "0"]

    def judge(self, python: str, port: int, episodes: int, processes: int) -> list[str]:
        """Return the command that judges it, in another Python environment."""
        return [
            *(python, "-m", "lorasp_jax.evaluation"),
            *("--server", f"ws://127.0.0.1:{port}", "--wait", "600"),
            *("--env", "examples.metaworld.world:mt50", "--tasks", *SETS[self.tasks]),
            *("--episodes", str(episodes), "--processes", str(processes)),
            *("--out", str(self.judged)),
        ]

    @property
    def judged(self) -> Path:
        """File with its episodes, which exists once it is finished."""
        return self.run / "judged.json"

    def result(self) -> dict[str, Any]:
        """Return its outcomes by task, a digit per episode, and its active ranks by module."""
        tasks = json.loads(self.judged.read_text())["tasks"]
        *_, last = (self.run / "metrics.jsonl").read_text().splitlines()
        ranks = {
            key.split("/")[1]: value for key, value in json.loads(last).items() if _is_rank(key)
        }
        return {
            "outcomes": {n: "".join(str(int(o)) for o in t["outcomes"]) for n, t in tasks.items()},
            "active_rank": ranks,
        }


def _is_rank(key: str) -> bool:
    """Say whether a metric is the active rank of a module, not of a layer."""
    return key.startswith("active_rank/") and key.count("/") == 1


def cells(backbones: Sequence[str]) -> Iterator[Cell]:
    """Yield all cells of the comparison, without the bases."""
    for backbone in backbones:
        for tasks in ("mt50", "ml5"):
            for method in METHODS:
                for seed in SEEDS:
                    yield Cell(backbone, tasks, method, seed)
