"""Run folders: nothing is overwritten, runs are locked, logs continue."""

import dataclasses
import json
import os
import resource

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from envs.scene.ranges import Randomization
from lorasp_jax.base.errors import DISK_FULL
from lorasp_jax.config import AugmentConfig, Config, DataConfig
from lorasp_jax.peft import LoRASP
from lorasp_jax.training import run_folder
from lorasp_jax.training.run_folder import (
    MetricsLog,
    read_metrics,
    record_dataset,
    recorded_ranges,
)

CONFIG = Config(name="a", scale="cpu", peft=LoRASP(rank=8))


def open_run(*arguments, **options):
    """Open and close a run; return its folder."""
    with run_folder.open_run(*arguments, **options) as folder:
        return folder


@pytest.mark.parametrize("character", "[*?\\")
def test_paths_in_which_orbax_finds_no_checkpoints_are_rejected(tmp_path, character):
    with pytest.raises(ValueError, match=r"cannot be restored from .*choose another --name"):
        open_run(dataclasses.replace(CONFIG, name=f"a{character}"), tmp_path, resume=False)
    with pytest.raises(ValueError, match="cannot be restored"):
        open_run(CONFIG, tmp_path / f"b{character}", resume=False)
    assert not list(tmp_path.iterdir())


def test_two_runs_do_not_share_a_folder(tmp_path):
    """The error names the holder; other names are free, and so is this one afterwards."""
    with run_folder.open_run(CONFIG, tmp_path, resume=False) as folder:
        before = (folder / "config.json").read_bytes()
        for resume in (False, True):
            with pytest.raises(
                ValueError, match=rf"is in use by process {os.getpid()} on \S+: wait"
            ):
                open_run(dataclasses.replace(CONFIG, seed=1), tmp_path, resume=resume)
        assert (folder / "config.json").read_bytes() == before
        open_run(dataclasses.replace(CONFIG, name="b"), tmp_path, resume=False)
    open_run(CONFIG, tmp_path, resume=True)


def test_resume_needs_the_same_settings(tmp_path):
    with pytest.raises(ValueError, match="no run to resume"):
        open_run(CONFIG, tmp_path, resume=True)
    folder = open_run(CONFIG, tmp_path, resume=False)
    assert open_run(CONFIG, tmp_path, resume=True) == folder
    other = dataclasses.replace(CONFIG, peft=LoRASP(rank=4), seed=3)
    with pytest.raises(
        ValueError, match=r"different settings \(peft\.alpha.*seed|peft\.rank, seed"
    ):
        open_run(other, tmp_path, resume=True)
    assert json.loads((folder / "config.json").read_text())["peft"]["rank"] == 8


def test_resume_auto_starts_or_continues(tmp_path):
    folder = open_run(CONFIG, tmp_path, resume="auto")
    (folder / "metrics.jsonl").write_text("precious\n")
    assert open_run(CONFIG, tmp_path, resume="auto") == folder
    assert (folder / "metrics.jsonl").read_text() == "precious\n"
    with pytest.raises(ValueError, match=r"different settings \(seed"):
        open_run(dataclasses.replace(CONFIG, seed=3), tmp_path, resume="auto")
    (folder / "config.json").unlink()
    with pytest.raises(ValueError, match="already contains a run"):
        open_run(CONFIG, tmp_path, resume="auto")


def test_settings_that_earlier_versions_lack_are_recorded_only_if_used():
    """So that runs from before these settings existed go on, and studies find them unchanged."""
    plain = run_folder.to_json(CONFIG)
    assert "chunk" not in plain["model"]
    config = dataclasses.replace(CONFIG, model=dataclasses.replace(CONFIG.model, chunk=16))
    assert run_folder.changed_settings(plain, run_folder.to_json(config)) == ["model.chunk"]
    assert not run_folder.changed_settings(plain, run_folder.to_json(CONFIG))


def test_a_run_from_before_held_out_episodes_says_how_to_resume(tmp_path):
    """It trained on all recordings, without augmentation."""
    recorded = dataclasses.replace(
        CONFIG,
        data=DataConfig(source="x", validation=("0",), augment=AugmentConfig("none")),
    )
    plain = run_folder.to_json(recorded)
    assert not {"validation", "augment"} & plain["data"].keys()
    open_run(recorded, tmp_path, resume=False)
    default = dataclasses.replace(CONFIG, data=DataConfig(source="x"))
    with pytest.raises(ValueError, match=r"--data\.validation 0 --data\.augment\.preset none"):
        open_run(default, tmp_path, resume=True)
    open_run(recorded, tmp_path, resume=True)


def test_a_run_of_another_version_needs_another_name(tmp_path):
    folder = open_run(CONFIG, tmp_path, resume=False)
    recorded = run_folder.to_json(CONFIG)
    recorded["optim"]["momentum"] = 0.9
    run_folder.write_json(folder / "config.json", recorded)
    expected = r"of another version, .* does not have \(optim\.momentum\): use another --name"
    with pytest.raises(ValueError, match=expected):
        open_run(CONFIG, tmp_path, resume=True)
    with pytest.raises(ValueError, match=expected):
        open_run(dataclasses.replace(CONFIG, seed=3), tmp_path, resume=True)


def test_only_ranges_that_change_something_are_recorded(tmp_path):
    """So that runs from before a range existed go on."""
    assert "scene" not in run_folder.to_json(CONFIG)
    ranges = Randomization(camera_turn=(0, 0.1), table_height=(0.02, 0.02))
    config = dataclasses.replace(CONFIG, scene=ranges)
    recorded = run_folder.to_json(config)
    assert recorded["scene"] == {"camera_turn": [0, 0.1], "table_height": [0.02, 0.02]}
    assert recorded_ranges(recorded) == config.ranges == ranges
    assert recorded_ranges(run_folder.to_json(CONFIG)) is CONFIG.ranges is None
    with pytest.raises(ValueError, match="unknown range 'wind': choose from position, turn"):
        recorded_ranges({"scene": {"wind": [0, 1]}})
    open_run(config, tmp_path, resume=False)
    open_run(config, tmp_path, resume=True)
    with pytest.raises(ValueError, match=r"different settings \(scene\)"):
        open_run(CONFIG, tmp_path, resume=True)
    other = dataclasses.replace(ranges, table_height=(0.0, 0.02))
    with pytest.raises(ValueError, match=r"\(scene.table_height\)"):
        open_run(dataclasses.replace(config, scene=other), tmp_path, resume=True)


@pytest.mark.parametrize("name", ["", "a", ".a.lock/"])
def test_a_path_of_another_kind_in_place_of_the_folder_or_lock(tmp_path, name):
    root = tmp_path / "runs"
    if name.endswith("/"):
        (root / name).mkdir(parents=True)
    else:
        (root / name).parent.mkdir(exist_ok=True)
        (root / name).write_text("a file")
    with pytest.raises(ValueError, match=r"is a file|cannot open"):
        open_run(CONFIG, root, resume=False)


@pytest.mark.parametrize("content", [b"{", b"[3]", b"3", b"\xff"])
def test_corrupt_config(tmp_path, content):
    folder = open_run(CONFIG, tmp_path, resume=False)
    (folder / "config.json").write_bytes(content)
    with pytest.raises(ValueError, match="is damaged"):
        open_run(CONFIG, tmp_path, resume=True)


def test_a_resumed_log_equals_an_uninterrupted_one(tmp_path):
    log = MetricsLog(tmp_path)
    for step in (2, 4, 6):
        log.write(step, {"loss": float(step)})
    log.close()
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 8, "lo')  # killed while writing
    log = MetricsLog(tmp_path, start_step=4)
    log.write(6, {"loss": -6.0})
    log.close()
    assert [row["loss"] for row in read_metrics(tmp_path)] == [2.0, 4.0, -6.0]
    assert list((tmp_path / "tensorboard").iterdir())


@pytest.mark.timeout(60)
def test_a_full_disk_stops_the_log_immediately(tmp_path):
    log = MetricsLog(tmp_path)

    def fill():
        for step in range(1000):
            log.write(step, {"loss": 1.0, "grad_norm": 2.0})

    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
    try:
        with pytest.raises(OSError, match="File too large") as caught:
            fill()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
        log.close()
    assert caught.value.errno in DISK_FULL
    assert len(read_metrics(tmp_path)) > 10


def test_tensorboard_reads_every_value(tmp_path):
    """A scalar and a histogram of the same name, from a run resumed at step 2."""
    name = "active_rank/vision/fc1"
    for start, steps in ((0, (2, 4)), (2, (4, 6))):
        log = MetricsLog(tmp_path, start)
        for step in steps:
            ranks = np.array([start, step], np.float32)
            log.write(step, {"loss": start + step / 2, name: float(ranks.mean())}, {name: ranks})
        log.close()
    assert read_metrics(tmp_path)[0] == {"step": 2, "loss": 1.0, name: 1.0}
    board = EventAccumulator(str(tmp_path / "tensorboard"), {"histograms": 0}).Reload()
    tags = board.Tags()
    assert (tags["scalars"], tags["histograms"]) == (["loss", name], [f"{name}/layers"])
    found = [(event.step, event.value) for event in board.Scalars("loss")]
    assert found == [(2, 1.0), (4, 4.0), (6, 5.0)]
    assert [event.value for event in board.Scalars(name)] == [1.0, 3.0, 4.0]
    values = [event.histogram_value for event in board.Histograms(f"{name}/layers")]
    assert [(value.num, value.min, value.max) for value in values] == [
        (2, 0, 2),
        (2, 2, 4),
        (2, 2, 6),
    ]


def test_non_finite_values_are_omitted(tmp_path):
    log = MetricsLog(tmp_path)
    log.write(2, {"loss": float("nan"), "grad_norm": float("inf"), "skipped": 2.0})
    log.close()
    assert read_metrics(tmp_path) == [{"step": 2, "skipped": 2.0}]


def test_a_name_is_free_after_a_run_that_failed_without_results(tmp_path):
    """For example if too much noise makes the expert fail."""
    noisy = dataclasses.replace(CONFIG, data=DataConfig(action_noise=0.1))
    folder = open_run(noisy, tmp_path, resume=False)
    (folder / "seconds.json").write_text('{"collect": 9.0, "total": 9.0}')
    record_dataset(folder, {"crc32": 1}, streams=True)
    (folder / "cache").mkdir()  # of a corrupt dataset
    assert open_run(CONFIG, tmp_path, resume=False) == folder
    files = [path.name for path in folder.iterdir() if path.is_file()]
    assert files == ["config.json"]  # times start from zero
    assert json.loads((folder / "config.json").read_text())["data"]["action_noise"] == 0.005


@pytest.mark.parametrize("left", ["cache/steps/cache.json", "cache/press.npz", "merged/config"])
def test_a_refused_run_leaves_nothing_but_results(tmp_path, left):
    """What the expert has collected is a result, a converted dataset or a merged base is not."""
    file = tmp_path / "runs" / CONFIG.name / left

    def refuse():
        file.parent.mkdir(parents=True)
        file.write_text("{}")
        raise ValueError("refused")

    with (
        pytest.raises(ValueError, match="refused"),
        run_folder.open_run(CONFIG, tmp_path / "runs", resume="auto"),
    ):
        refuse()
    assert (tmp_path / "runs").exists() == file.exists() == (left == "cache/press.npz")


def test_a_run_keeps_its_dataset_and_whether_it_streams(tmp_path):
    facts = {"crc32": {"state": 1}, "instructions": ["press"]}
    assert not record_dataset(tmp_path, facts, streams=False)
    assert not record_dataset(tmp_path, facts, streams=False)
    assert record_dataset(tmp_path, facts, streams=True)
    (tmp_path / "dataset.json").unlink()
    assert record_dataset(tmp_path, facts, streams=True)
    assert record_dataset(tmp_path, facts, streams=False)
    with pytest.raises(ValueError, match=r"the dataset differs from the one .* was started with"):
        record_dataset(tmp_path, facts | {"crc32": {"state": 2}}, streams=True)


@pytest.mark.parametrize("more", ["cache/pick_place.npz", "before.json"])
def test_a_run_with_results_is_not_overwritten(tmp_path, more):
    folder = open_run(CONFIG, tmp_path, resume=False)
    (folder / more).parent.mkdir(exist_ok=True)
    (folder / more).write_text("more")
    with pytest.raises(ValueError, match="already contains a run: add --resume"):
        open_run(dataclasses.replace(CONFIG, seed=1), tmp_path, resume=False)
    assert (folder / more).read_text() == "more"
    assert json.loads((folder / "config.json").read_text())["seed"] == 0


def test_a_run_with_a_link_to_the_outside_is_not_resumed(tmp_path):
    folder = open_run(CONFIG, tmp_path / "runs", resume=False)
    (tmp_path / "precious.mp4").write_text("precious")
    (folder / "unfinished_press.mp4").symlink_to("../../precious.mp4")
    with pytest.raises(
        ValueError, match=r"unfinished_press.mp4 links to .*precious.mp4, outside of"
    ):
        open_run(CONFIG, tmp_path / "runs", resume=True)


def test_temporary_files_of_a_killed_process_are_removed(tmp_path):
    folder = tmp_path / CONFIG.name
    folder.mkdir()
    (folder / ".config.json.0123abcd.tmp").write_text("{")
    open_run(CONFIG, tmp_path, resume=False)
    assert [path.name for path in folder.iterdir()] == ["config.json"]


@pytest.mark.timeout(20)
def test_pipes_in_place_of_files_do_not_block(tmp_path):
    for name in ("config.json", "metrics.jsonl"):
        os.mkfifo(tmp_path / name)
    with pytest.raises(ValueError, match=r"config\.json must be a regular file"):
        run_folder.read_json(tmp_path / "config.json")
    with pytest.raises(ValueError, match=r"metrics\.jsonl must be a regular file"):
        read_metrics(tmp_path)
