"""Files of a finished policy of the comparison on Meta-World."""

import json

from studies.metaworld.cells import STAGES
from studies.metaworld.tasks import SETS


def write_judged(cell, right, episodes=None, seed=None):
    """Write the files of a finished cell that succeeds in the first `right` episodes of a task."""
    stage = STAGES[cell.stage]
    count = stage.episodes if episodes is None else episodes
    outcomes = {"outcomes": [True] * right + [False] * (count - right)}
    cell.run.mkdir(parents=True, exist_ok=True)
    cell.judged.write_text(
        json.dumps(
            {
                "seed": stage.first_seed if seed is None else seed,
                "tasks": dict.fromkeys(SETS[stage.tasks], outcomes),
            }
        )
    )
    parameters = {"trainable_parameters": 1, "total_parameters": 4}
    (cell.run / "results.json").write_text(json.dumps(parameters))
    (cell.run / "config.json").write_text(json.dumps({"optim": {"learning_rate": 0.5}}))
    ranks = {"active_rank/vision": 3.25, "active_rank/vision/q_proj": 9.0, "loss": 1.0}
    (cell.run / "metrics.jsonl").write_text("{}\n" + json.dumps(ranks) + "\n")
