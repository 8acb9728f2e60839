"""The command line never overwrites, truncates or loses a file."""

import itertools
import os
import signal
import subprocess
import sys
import threading

import jax
import numpy as np
import pytest
from PIL import Image

import envs
from envs import __main__ as command_line
from envs.datasets import rlds
from envs.experts import collection
from lorasp_jax.base import locks, writing
from tests import ROOT
from tests.cases import mostly_slow
from tests.envs import user_arm
from tests.envs.children import COLLECT, MOMENTS, fake_record
from tests.envs.datasets.test_episodes import assert_equal, make
from tests.envs.datasets.test_rlds import trimmed


def stopping(function, calls):
    """Wrap a function to raise KeyboardInterrupt after a number of calls."""
    count = itertools.count()

    def stopped(*arguments, **options):
        if next(count) == calls:
            raise KeyboardInterrupt
        return function(*arguments, **options)

    return stopped


@pytest.fixture
def run(capsys, monkeypatch):
    """Return a function that runs a command, by default without simulation: exit code, output."""
    # These change the process.
    monkeypatch.setattr(command_line.cache, "enable", lambda: None)

    def run(text, *more, record=fake_record):
        monkeypatch.setattr(collection, "record_expert", record)
        code = command_line.main([*text.split(), *map(str, more)])
        return code, " ".join(capsys.readouterr().err.split())

    return run


def test_bad_input_is_one_sentence(tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    existing, photos = tmp_path / "movie.mp4", tmp_path / "photos"
    existing.write_text("precious")
    photos.mkdir()
    press = "--task press --robot piper --out"
    for text, out, message in (
        (f"play {press}", existing, "already exists"),
        (f"collect {press}", photos, "photos"),
        (f"collect --num-episodes 0 {press}", tmp_path / "new", "num_episodes"),
        (f"collect --num-envs 0 {press}", tmp_path / "new", "num_envs"),
        (f"collect --randomize --control-dt 0.02 {press}", tmp_path / "new", "latency"),
        (f"collect --control-dt 0.03 {press}", tmp_path / "new", "multiple of 0.02 s"),
        (f"collect --actions voltage {press}", tmp_path / "new", "joint, delta_joint, end_eff"),
        (f"collect --distractors 5 {press}", tmp_path / "new", "distractors"),
        ("collect --task press dance --robot piper --out", tmp_path / "new", "dance"),
        (f"play --image-size 33 {press}", tmp_path / "a.mp4", "must be even, got 33"),
        ("play --task dance --robot piper --out", tmp_path / "a.mp4", "dance"),
        ("gallery --task press --robot r2d2 --out", tmp_path / "g", "r2d2"),
        (f"collect {press}", "gs://bucket/press", "URL gs:/bucket/press"),
        (f"play {press}", "gs://bucket/press.mp4", "URL gs:/bucket/press.mp4"),
        ("gallery --task press --robot piper --out", "gs://bucket", "press_piper.gif"),
    ):
        code, output = run(text, out)
        assert code == 2
        assert message in output
        assert "Traceback" not in output
    assert existing.read_text() == "precious"
    assert sorted(os.listdir(tmp_path)) == ["movie.mp4", "photos"]


def test_play_and_gallery_write_files(tmp_path, run, monkeypatch):
    def collect(task, robot, *, num_episodes, progress, **options):
        assert options["num_envs"] == 1  # only shown images are rendered
        progress(0, num_episodes)
        progress(num_episodes, num_episodes)
        length = np.full(num_episodes, 4, np.int32)
        return make(num_episodes, length=length, task=task, robot=robot)

    monkeypatch.setattr(envs, "collect", collect)
    for command, out in (("play", "v.mp4"), ("gallery", "g")):
        code, output = run(f"{command} --task press --robot piper --out", tmp_path / out)
        assert code == 0, output
    assert (tmp_path / "v.mp4").read_bytes()[4:8] == b"ftyp"
    (file,) = (tmp_path / "g").iterdir()
    assert file.name == "press_piper.gif"
    with Image.open(file) as picture:
        assert picture.size == (2 * 8, 6)  # both cameras
        assert picture.n_frames == 2  # every second step of four
        assert picture.info["duration"] == 200  # ms


def test_collect_writes_the_episodes_of_the_library(tmp_path, run):
    code, output = run(COLLECT, "--out", tmp_path / "press", "--actions", "delta_joint")
    assert code == 0, output
    assert "20/20" in output
    expected = envs.collect(
        "press",
        num_episodes=20,
        num_envs=6,
        actions="delta_joint",
        key=jax.random.key(0),
    )
    assert expected.attempted > 20
    found = rlds.read(tmp_path / "press")
    assert_equal(found, trimmed(expected))
    assert f"20 of {found.attempted} attempted episodes, {found.num_steps} steps" in output
    assert os.listdir(tmp_path) == ["press"]
    assert (
        rlds.metadata(tmp_path / "press")["options"].items() >= {"seed": 0, "num_envs": 6}.items()
    )


@pytest.mark.parametrize("moment", mostly_slow(MOMENTS, [*MOMENTS][:1]))
def test_killed_and_resumed(tmp_path, run, moment):
    run(COLLECT, "--out", tmp_path / "whole")
    out, unfinished = tmp_path / "killed", tmp_path / "killed.partial"
    code = f"from tests.envs import children; children.collect_and_die({moment!r}, {str(out)!r})"
    child = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, check=False)
    assert child.returncode == -signal.SIGKILL, child.stderr
    assert not out.exists()
    before = {file: file.stat().st_mtime_ns for file in unfinished.glob("*array_record*")}
    parts = rlds.metadata(unfinished)["parts"]

    code, output = run(COLLECT, "--out", out, "--seed", 1)
    assert code == 2
    assert "killed.partial has seed 0, not 1" in output

    code, output = run(COLLECT, "--out", out)
    assert code == 0, output
    assert_equal(rlds.read(out), rlds.read(tmp_path / "whole"))
    assert rlds.metadata(out) == rlds.metadata(tmp_path / "whole")
    assert sorted(os.listdir(out)) == sorted(os.listdir(tmp_path / "whole"))
    assert not unfinished.exists()
    for file in sorted(before)[: len(parts)]:  # complete shards were not collected again
        assert (out / file.name).stat().st_mtime_ns == before[file]


def test_randomized_worlds_resume_and_stay_complete(tmp_path, run):
    whole, out = tmp_path / "whole", tmp_path / "press"
    text = f"{COLLECT} --randomize"
    assert run(text, "--out", whole)[0] == 0
    code, _ = run(text, "--out", out, record=stopping(fake_record, 2))
    assert code == 130
    code, output = run(text, "--out", out)
    assert code == 0, output
    assert rlds.metadata(out) == rlds.metadata(whole)
    code, output = run(text, "--out", out)
    assert (code, output.endswith("press is already complete")) == (0, True), output


@pytest.mark.slow
def test_an_interrupted_simulation_resumes_bit_for_bit(tmp_path, run, env, monkeypatch):
    for module in (envs, collection):
        monkeypatch.setattr(module, "make", lambda *arguments, **options: env)
    text, out = "collect --task press --robot piper --num-episodes 10", tmp_path / "press"
    expert = collection.record_expert
    code, output = run(text, "--out", out, record=stopping(expert, 2))
    assert code == 130
    assert f"interrupted; 8 of 10 episodes are in {out}.partial; run the same command" in output
    assert run(text, "--out", out, record=expert)[0] == 0
    whole = envs.collect("press", num_episodes=10, key=jax.random.key(0))
    assert_equal(rlds.read(out), trimmed(whole))


def test_interrupted_before_the_first_shard(tmp_path, run, monkeypatch):
    monkeypatch.setattr(rlds, "ShardWriter", stopping(rlds.ShardWriter, 0))
    code, output = run(COLLECT, "--out", tmp_path / "press")
    assert code == 130
    assert output.endswith("interrupted; temporary files were removed")
    assert not list(tmp_path.iterdir())


def test_several_tasks_resume(tmp_path, run, monkeypatch):
    text, out = COLLECT.replace("press", "all"), tmp_path / "many"
    with monkeypatch.context() as patch:
        patch.setattr(writing, "rename", stopping(writing.rename, 2))
        code, output = run(text, "--out", out)
    assert code == 130
    done, rest = ([f for f in out.iterdir() if (f.suffix == ".partial") == p] for p in (0, 1))
    assert len(done) >= 2
    assert all(f"of 20 episodes are in {folder}; run the same" in output for folder in rest)
    before = {folder: folder.stat() for folder in done}
    code, output = run(text, "--out", out)
    assert code == 0, output
    for folder in done:
        assert f"{folder} is already complete" in output
        assert folder.stat() == before[folder]
    assert sorted(os.listdir(out)) == ["open_pot", "pick_place", "pour", "press", "two_baskets"]
    run(COLLECT, "--out", tmp_path / "press")
    assert_equal(rlds.read(tmp_path / "press"), rlds.read(out / "press"))
    code, output = run(text, "--out", out, "--seed", 1)
    assert code == 2
    assert "open_pot already exists: choose another --out" in output


def test_one_bad_task_stops_the_others(tmp_path, run):
    def record(env, key, action_noise, ranges):
        episodes, success = fake_record(env, key, action_noise, ranges)
        return episodes, success & (env.task.name != "pour")

    text = COLLECT.replace("press", "press pour")
    code, output = run(text, "--out", tmp_path, record=record)
    assert code == 2
    assert "error: the expert solved only 0 of 18 layouts of 'pour'" in output


def test_ctrl_c_keeps_the_current_shard(tmp_path, run):
    calls, noticed = itertools.count(), threading.Event()

    def notice(*_):
        noticed.set()
        raise KeyboardInterrupt

    def record(*arguments):
        if next(calls) == 1:
            os.kill(os.getpid(), signal.SIGINT)
            assert noticed.wait(60)  # the main thread may be slow on a busy machine
        return fake_record(*arguments)

    before = signal.signal(signal.SIGINT, notice)
    try:
        code, output = run(COLLECT, "--out", tmp_path / "press", record=record)
    finally:
        signal.signal(signal.SIGINT, before)
    assert code == 130
    assert len(rlds.metadata(tmp_path / "press.partial")["parts"]) == 2
    assert "episodes are in" in output


@pytest.mark.slow
def test_an_edited_robot_is_a_different_one(tmp_path, run):
    text = COLLECT.replace("piper", str(user_arm.write(tmp_path)))
    assert run(text, "--out", tmp_path / "done")[0] == 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rlds.ShardWriter, "complete", stopping(rlds.ShardWriter.complete, 0))
        assert run(text, "--out", tmp_path / "begun")[0] == 130
    code, output = run(text, "--out", tmp_path / "done")
    assert (code, "is already complete" in output) == (0, True)
    user_arm.write(tmp_path, ('kp="150"', 'kp="140"'))
    code, output = run(text, "--out", tmp_path / "done")
    assert (code, "already exists" in output) == (2, True)
    code, output = run(text, "--out", tmp_path / "begun")
    assert (code, "begun.partial has model" in output) == (2, True)


def test_a_second_process_is_refused(tmp_path, run):
    out = tmp_path / "press"
    with locks.locked(out):
        code, output = run(COLLECT, "--out", out)
        assert code == 2
        assert f"{out} is in use by process {os.getpid()} on" in output
        assert not out.with_name("press.partial").exists()
    assert run(COLLECT, "--out", out)[0] == 0
    assert os.listdir(tmp_path) == ["press"]
