import dataclasses

import pytest

from envs.scene.ranges import Randomization
from lorasp_jax.config import AugmentConfig, DataConfig
from lorasp_jax.extras.study import progress
from lorasp_jax.extras.study.progress import CellState
from lorasp_jax.extras.study.study import Derived, Study
from lorasp_jax.peft import AdaLoRA, FullFineTuning, LoRASP
from lorasp_jax.training.finished_run import recorded_config
from lorasp_jax.training.run_folder import to_json, write_json
from tests.runs import CONFIG, RESULTS, write_description

TASKS = {task: RESULTS["tasks"]["press"] for task in CONFIG.tasks}


@pytest.mark.parametrize(
    "changes",
    [
        {"peft": LoRASP(rank=4, energy_target=0.5)},
        {"peft": AdaLoRA(rank=4, target_rank=2), "scene": Randomization(turn=(0.0, 0.1))},
        {"peft": FullFineTuning(), "optim": dataclasses.replace(CONFIG.optim, rtc_max_delay=3)},
        {"data": DataConfig(source="x", cameras=("a", "b"), validation=("0.1",))},
        {"data": DataConfig(source="x", augment=AugmentConfig("lerobot", hue=0.1))},
        {"data": DataConfig(source="x", augment=AugmentConfig("none"), validation=("0",))},
        {"data": DataConfig(("a", "b"), weights=(2.0,), replay=0.1, statistics="each")},
        {"adapt": ("language=lora:4", "action=full")},
        *(
            {"model": dataclasses.replace(CONFIG.model, relative_actions=relative)}
            for relative in (None, False, True)
        ),
    ],
)
def test_configs_are_read_as_written(tmp_path, changes):
    config = dataclasses.replace(CONFIG, **changes)
    write_json(tmp_path / "config.json", to_json(config))
    write_json(tmp_path / "results.json", RESULTS | {"tasks": TASKS})
    write_description(tmp_path, robot="so100")  # that of the dataset
    assert recorded_config(tmp_path) == dataclasses.replace(config, robot="so100")


def test_unfinished_runs_are_refused(tmp_path):
    write_json(tmp_path / "config.json", to_json(CONFIG))
    with pytest.raises(ValueError, match="is not a finished run"):
        recorded_config(tmp_path)
    write_json(tmp_path / "results.json", RESULTS | {"tasks": {}})
    with pytest.raises(ValueError, match="cannot be simulated"):
        recorded_config(tmp_path)


def test_cells_of_a_run(tmp_path):
    """They can run if the run is here; results of theirs count even if it is not."""
    run, cell = tmp_path / "run", Derived("a", tmp_path / "run", settings={"delay": 3})
    study = Study("x", (cell,))
    assert progress.read(study, tmp_path)["a"].state == CellState.FAILED
    settings = progress.describe_config(cell, CONFIG)
    assert (settings["source"], settings["delay"]) == (str(run), 3)
    known = dataclasses.replace(study, finished={"a": {"config": settings, "outcomes": {}}})
    assert progress.read(known, tmp_path)["a"].state == CellState.FINISHED
    run.mkdir()
    write_json(run / "config.json", to_json(CONFIG))
    write_json(run / "results.json", RESULTS | {"tasks": TASKS})
    write_description(run)
    assert progress.read(study, tmp_path)["a"].state == CellState.RUNNABLE
    assert progress.read(known, tmp_path)["a"].state == CellState.FINISHED
    other = dataclasses.replace(known, cells=(dataclasses.replace(cell, settings={"delay": 4}),))
    assert progress.read(other, tmp_path)["a"].reason == "it was run with other delay"
