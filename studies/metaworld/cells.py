"""The policies that docs/metaworld.md compares, and the commands that make and judge them."""

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from studies.metaworld.tasks import SETS

Results = Mapping[str, Mapping[str, Any]]
"""Name of a policy -> its result; see `Cell.result`."""
SEEDS, PILOT_SEED = (0, 1, 2), 1000
METHODS = {
    "lora_sp": ("--method", "lora_sp", "--peft.rank", "64"),
    "lora_r64": ("--method", "lora", "--peft.rank", "64"),
    "lora_r16": ("--method", "lora", "--peft.rank", "16"),
    "ada_lora": ("--method", "ada_lora", "--peft.rank", "64", "--peft.target-rank", "16"),
    "full": ("--method", "full"),
}
"""Name of a method -> its options of train.py."""
RATES = (3e-4, 1e-3, 3e-3)
"""Learning rates, of which short pilots choose one per backbone and method."""
TUNED_AS = {"lora_r16": "lora_r64"}
"""Method -> the method whose rate it takes."""


@dataclass(frozen=True)
class Stage:
    """How the policies of one kind are trained and judged.

    Attributes:
        tasks: what they learn and are judged on, a key of `SETS`.
        steps: training steps.
        episodes: judged episodes per task.
        first_seed: seed of the first episode.
    """

    tasks: str
    steps: int
    episodes: int
    first_seed: int = 0


STAGES = {
    "pilot": Stage("mt50", 2_000, 5, 10_000),
    "mt50": Stage("mt50", 6_000, 10),
    "ml45": Stage("ml45", 10_000, 0),  # only a base
    "ml5": Stage("ml5", 2_000, 10),
}


@dataclass(frozen=True)
class Cell:
    """One policy.

    Attributes:
        backbone: pi0 or smolvla.
        stage: a key of `STAGES`.
        method: a key of `METHODS`.
        seed: its seed.
        pilot_rate: learning rate of a pilot; others take that of the best pilot.
    """

    backbone: str
    stage: str
    method: str
    seed: int
    pilot_rate: float = 0.0

    @property
    def name(self) -> str:
        """Name of its run, and of its entry in the results."""
        last = f"{self.pilot_rate:g}" if self.pilot_rate else f"s{self.seed}"
        return f"metaworld_{self.backbone}_{self.stage}_{self.method}_{last}"

    @property
    def run(self) -> Path:
        """Folder of its run."""
        return Path("runs") / self.name

    @property
    def pilots(self) -> tuple["Cell", ...]:
        """The policies whose success decides its learning rate."""
        if self.pilot_rate:
            return ()
        method = TUNED_AS.get(self.method, self.method)
        return tuple(Cell(self.backbone, "pilot", method, PILOT_SEED, rate) for rate in RATES)

    @property
    def base(self) -> "Cell | None":
        """The fully fine-tuned policy that it starts from; None: the bundled base."""
        return Cell(self.backbone, "ml45", "full", 0) if self.stage == "ml5" else None

    @property
    def needs(self) -> tuple["Cell", ...]:
        """The policies that must be finished first."""
        return (*self.pilots, self.base) if self.base else self.pilots

    def rate(self, results: Results) -> float:
        """Return its learning rate, which the results of its pilots decide."""
        best = max(self.pilots, key=lambda pilot: success(results[pilot.name]), default=self)
        return best.pilot_rate

    def train(self, data: Path, rate: float) -> list[str]:
        """Return the command that trains it on demonstrations in `data`, or resumes its run."""
        stage = STAGES[self.stage]
        options = {
            "name": self.name,
            "seed": self.seed,
            "data.source": data / stage.tasks,
            "model.backbone": self.backbone,
            "optim.steps": stage.steps,
            "optim.learning-rate": rate,
        }
        if self.base:
            options["model.checkpoint"] = self.base.run / "base"
        pairs = [text for key, value in options.items() for text in (f"--{key}", str(value))]
        start = [sys.executable, "train.py", "--config", "configs/metaworld.py"]
        start += ["--scale", "accelerator", "--resume", "auto"]
        return [*start, *METHODS[self.method], *pairs]

    def serve(self, port: int) -> list[str]:
        """Return the command that serves it."""
        command = [sys.executable, "-m", "lorasp_jax.extras.serving", str(self.run)]
        return [*command, "--port", str(port), "--seed", "0"]

    def judge(self, python: str, port: int, processes: int) -> list[str]:
        """Return the command that judges it, in another Python environment."""
        stage = STAGES[self.stage]
        return [
            *(python, "-m", "lorasp_jax.extras.judge"),
            *("--server", f"ws://127.0.0.1:{port}", "--wait", "600"),
            *("--env", "studies.metaworld.world:mt50", "--tasks", *SETS[stage.tasks]),
            *("--episodes", str(stage.episodes), "--seed", str(stage.first_seed)),
            *("--processes", str(processes), "--out", str(self.judged)),
        ]

    @property
    def judged(self) -> Path:
        """File with its episodes, written last."""
        return self.run / "judged.json"

    def outcomes(self) -> dict[str, str]:
        """Return a digit per episode, 1 for success, by task.

        Raises:
            ValueError: the file is damaged, or has other episodes than this comparison's.
        """
        stage, judged = STAGES[self.stage], _read(self.judged)
        tasks = {n: "".join(str(int(o)) for o in t["outcomes"]) for n, t in judged["tasks"].items()}
        right = [judged["seed"] == stage.first_seed, set(tasks) == set(SETS[stage.tasks])]
        if not all([*right, *(len(text) == stage.episodes for text in tasks.values())]):
            raise ValueError(f"{self.judged} has other tasks or episodes: delete it")
        return tasks

    def result(self) -> dict[str, Any]:
        """Return its outcomes, active ranks by module, learning rate and trainable share.

        Raises:
            ValueError: see `outcomes`; also if a file of the run is damaged.
        """
        outcomes, run = self.outcomes(), _read(self.run / "results.json")
        *_, last = (self.run / "metrics.jsonl").read_text().splitlines() or [""]
        metrics = {} if last == "" else json.loads(last)
        ranks = {key.split("/")[1]: value for key, value in metrics.items() if _is_rank(key)}
        return {
            "outcomes": outcomes,
            "active_rank": ranks,
            "rate": _read(self.run / "config.json")["optim"]["learning_rate"],
            "trainable": run["trainable_parameters"] / run["total_parameters"],
        }


def success(result: Mapping[str, Any]) -> float:
    """Return the success rate over all episodes of a result."""
    digits = "".join(result["outcomes"].values())
    return digits.count("1") / len(digits)


def _read(path: Path) -> dict[str, Any]:
    """Read a JSON file; a damaged one raises ValueError with its name."""
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is damaged, delete it: {error}") from error


def _is_rank(key: str) -> bool:
    """Say whether a metric is the active rank of a module, not of a layer."""
    return key.startswith("active_rank/") and key.count("/") == 1


def cells(backbones: Sequence[str]) -> Iterator[Cell]:
    """Yield all policies of the comparison, each after those that it needs."""
    for backbone in backbones:
        for method in METHODS:
            if method not in TUNED_AS:
                yield from Cell(backbone, "mt50", method, 0).pilots
    for backbone in backbones:
        yield Cell(backbone, "ml45", "full", 0)
    for backbone in backbones:
        for stage in ("mt50", "ml5"):
            for method in METHODS:
                for seed in SEEDS:
                    yield Cell(backbone, stage, method, seed)
