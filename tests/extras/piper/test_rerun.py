"""Test Rerun's recordings of the fake arm's episodes, and that a viewer never holds an arm up."""

import importlib.util
import io
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lorasp_jax.extras.piper import rerun_log
from lorasp_jax.extras.piper.__main__ import main as real
from lorasp_jax.extras.piper.fake.__main__ import main as fake
from lorasp_jax.extras.piper.rerun_log import Viewer, WatchedLog
from lorasp_jax.extras.piper.rerun_writer import Writer, joint_names, main
from lorasp_jax.extras.serving import wire
from tests.extras.piper.piper_runs import Run, Turning, assert_safe

needs_rerun = pytest.mark.skipif(
    importlib.util.find_spec("rerun") is None, reason="rerun-sdk is not installed"
)
JOINTS = joint_names(7)


def read(path):
    """Return the rows (time [s], values) of each entity of a recording, in the order of time."""
    from rerun.chunk import RrdReader

    rows = {}
    for chunk in RrdReader(str(path)).stream().to_chunks():
        if "time" not in chunk.timeline_names:
            continue
        batch = chunk.to_record_batch()
        names = batch.schema.names
        wanted = next(name for name in names if name.endswith((":scalars", ":blob", ":text")))
        values = batch.column(names.index(wanted)).to_pylist()
        times = [time.value / 1e9 for time in batch.column(names.index("time"))]
        rows.setdefault(chunk.entity_path.lstrip("/"), []).extend(zip(times, values, strict=True))
    return {name: sorted(each, key=lambda row: row[0]) for name, each in rows.items()}


def line(rows):
    """Return the times [s] and values of scalars, NaN where the line breaks."""
    times, values = zip(*rows, strict=True)
    return np.array(times), np.array([x[0] if x else np.nan for x in values])


def episode(log, bench, number, seconds=1.0, **options):
    log.line(bench.clock.now(), episode=number)
    run = Run(bench, Turning(), log=log, **options)
    assert run(seconds) is None
    assert_safe(run)


@needs_rerun
def test_a_recording_has_what_was_predicted_and_what_was_executed(bench, tmp_path):
    viewer = Viewer(str(tmp_path / "films"), 0.1)
    log = WatchedLog(tmp_path / "log", viewer)
    episode(log, bench, 0, latency=0.02, settings={"ahead": 1})
    episode(log, bench, 1, 0.3)
    timings = {"policy_timing": {"infer_ms": 13.0}, "server_timing": {"infer_ms": 15.5}}
    viewer.reply(timings | {"active_rank": 11.5})
    log.close()
    assert viewer.dropped == 0
    rows = read(tmp_path / "films/episode-0000.rrd")
    for joint in JOINTS:
        for kind in ("measured", "commanded"):
            times, _ = line(rows[f"{joint}/{kind}"])
            assert times[0] < 0.03
            assert np.diff(times) == pytest.approx(rerun_log.TICK, abs=1e-6)
            assert 0.9 < times[-1] < 1.1
    when, commanded = line(rows["joint_1/commanded"])
    logged = [json.loads(text) for text in (tmp_path / "log/log.jsonl").read_text().splitlines()]
    chunks = [each for each in logged if "chunk" in each][:2]
    lanes = sorted(name for name in rows if name.startswith("joint_1/predicted"))
    assert lanes == ["joint_1/predicted/0", "joint_1/predicted/1"]  # as they overlap
    for lane, logged in zip(lanes, chunks, strict=True):
        times, values = line(rows[lane])
        np.testing.assert_allclose(values[:-1], np.array(logged["chunk"])[:, 0], atol=1e-6)
        assert np.isnan(values[-1])  # the line ends here
        assert np.diff(times) == pytest.approx(0.1, abs=1e-6)
        executed = slice(1, 4)  # the first action was in the past when the second chunk arrived
        followed = np.interp(times[executed], when, commanded)
        np.testing.assert_allclose(followed, values[executed], atol=0.01)
    assert [round(x[0], 3) for _, x in rows["latency_ms/answer"]] == [20.0] * len(chunks)
    assert line(rows["steps/executed"])[1] == [5]
    assert line(rows["steps/delay"])[1] == [1]
    pictures = rows["camera/side"]
    assert len(pictures) == len(rows["latency_ms/answer"])
    assert bytes(pictures[0][1][0])[:2] == b"\xff\xd8"  # JPEG
    assert rows["events"][0][1] == ["turn"]
    rows = read(tmp_path / "films/episode-0001.rrd")
    assert line(rows["joint_1/measured"])[0][-1] < 0.4
    assert line(rows["latency_ms/server/waiting"])[1] == pytest.approx([2.5])
    assert line(rows["active_rank"])[1] == [11.5]


@needs_rerun
def test_the_command_records_episodes_into_free_files(server, tmp_path, world, monkeypatch):
    monkeypatch.setattr("lorasp_jax.extras.piper.fake.__main__.World", lambda *_, **__: world)
    monkeypatch.setattr("lorasp_jax.extras.piper.options.task", lambda name: Brief)
    server.policy.seconds = 0.01
    (tmp_path / "films").mkdir()
    (tmp_path / "films/episode-0006.rrd").touch()
    words = ["--server", server.address, "--task", "press", "--episodes", "2"]
    words += ["--log", str(tmp_path / "log"), "--rerun", str(tmp_path / "films")]
    assert fake(words) == 0
    names = sorted(path.name for path in (tmp_path / "films").iterdir())
    assert names == ["episode-0006.rrd", "episode-0007.rrd", "episode-0008.rrd"]
    rows = read(tmp_path / "films/episode-0008.rrd")
    assert line(rows["latency_ms/policy/infer"])[1].min() >= 10
    assert line(rows["latency_ms/server/infer"])[1].min() >= 10


class Brief:
    time_limit, instructions, name = 0.4, ("press it",), "press"


def frames(*messages):
    packed = [wire.pack(message) for message in messages]
    return b"".join(len(frame).to_bytes(4) + frame for frame in packed)


TICK = {"pose": np.zeros(7), "command": np.ones(7), "age": 0.001}


@needs_rerun
def test_a_killed_client_leaves_a_complete_recording(tmp_path, capsys):
    sent = frames({"t": 5.0, "episode": 0}, {"t": 5.5, **TICK}) + frames({"t": 6.0, **TICK})[:20]
    assert main(str(tmp_path), io.BytesIO(sent)) == 0
    assert capsys.readouterr().out == "ready\n"
    times, values = line(read(tmp_path / "episode-0000.rrd")["gripper/commanded"])
    assert (times.tolist(), values.tolist()) == ([0.5], [1.0])


def listens(number):
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", number)) == 0


@needs_rerun
@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # of the viewer's, while it writes
def test_a_viewer_gets_what_is_sent_to_its_address(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as port:
        number = port.getsockname()[1]
    words = ["--save", str(tmp_path / "all.rrd"), "--bind", "127.0.0.1", "--port", str(number)]
    command = [sys.executable, "-m", "rerun", *words]
    with subprocess.Popen(command, start_new_session=True) as process:  # it starts another one
        try:
            end = time.monotonic() + 60
            while not listens(number):
                assert time.monotonic() < end
                time.sleep(0.1)
            viewer = Viewer(f"rerun+http://127.0.0.1:{number}/proxy", 0.1)
            viewer.line(3.0, episode=0)
            viewer.line(3.25, **TICK)
            viewer.close()
            while "gripper/commanded" not in (rows := read(tmp_path / "all.rrd")):
                assert time.monotonic() < end
                time.sleep(0.1)
        finally:
            os.killpg(process.pid, signal.SIGKILL)
    assert line(rows["gripper/commanded"]) == ([0.25], [1.0])


@needs_rerun
def test_a_stuck_viewer_delays_nothing_and_costs_bounded_memory(monkeypatch, capsys):
    monkeypatch.setattr(rerun_log, "GRACE", 1.0)
    picture = np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8)
    with socket.create_server(("127.0.0.1", 0)) as port:  # accepts, and never reads
        viewer = Viewer(f"rerun+http://127.0.0.1:{port.getsockname()[1]}/proxy", 0.1)
        viewer.line(0.0, episode=0)
        worst = 0.0
        for step in range(3000):
            start = time.perf_counter()
            viewer.line(0.02 * step, **TICK)
            viewer.observation(0.02 * step, {"image": {"side": picture}})
            worst = max(worst, time.perf_counter() - start)
        assert worst < 0.5  # the threads of this process share its time, and other tests the cores
        assert viewer._queue.qsize() <= rerun_log.MOST
        assert viewer.dropped > 1000
        pages = int(Path(f"/proc/{viewer._process.pid}/statm").read_text().split()[1])
        assert pages * resource.getpagesize() < 2**29
        start = time.perf_counter()
        viewer.close()
        assert time.perf_counter() - start < 10
    printed = capsys.readouterr().out
    assert f"{viewer.dropped} messages are missing" in printed
    assert "did not take it in time" in printed


@needs_rerun
def test_a_full_disk_is_said_at_the_end(tmp_path):
    viewer = Viewer(str(tmp_path), 0.1)
    resource.prlimit(viewer._process.pid, resource.RLIMIT_FSIZE, (2000, 2000))
    viewer.line(0.0, episode=0)
    for step in range(200):
        viewer.line(0.02 * step, **TICK)
    with pytest.raises(OSError, match=r"incomplete: .* see whether there is space"):
        viewer.close()


@needs_rerun
@pytest.mark.parametrize("target", ["http://a:1/proxy", "rerun+http://a", "rerun+http://a:1"])
def test_addresses_are_checked(target):
    with pytest.raises(ValueError, match="must be a folder or an address rerun"):
        Writer(target)


@needs_rerun
def test_a_viewer_that_is_not_there():
    with socket.create_server(("127.0.0.1", 0)) as port:
        number = port.getsockname()[1]
    with pytest.raises(ValueError, match=f"no viewer at .*:{number}/proxy"):
        Viewer(f"rerun+http://127.0.0.1:{number}/proxy", 0.1)


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("raise ModuleNotFoundError('rerun')", "needs the package rerun-sdk"),
        ("", "not that of rerun-sdk"),
    ],
)
def test_a_missing_or_wrong_package_is_named(tmp_path, monkeypatch, source, said):
    (tmp_path / "rerun").mkdir()
    (tmp_path / "rerun/__init__.py").write_text(source)
    (tmp_path / "rerun/blueprint.py").touch()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    with pytest.raises(ValueError, match=said) as error:
        Viewer(str(tmp_path / "films"), 0.1)
    assert 'pip install "lorasp_jax[rerun]"' in str(error.value)


def test_replies_may_be_anything():
    assert rerun_log._numbers({"a": 1, "b": "x", "c": [1], "d": np.float32(2)}) == {"a": 1, "d": 2}
    assert rerun_log._numbers(["a"]) == rerun_log._numbers(None) == {}


def test_large_pictures_are_shown_small():
    small = np.arange(320 * 240 * 3, dtype=np.uint8).reshape(240, 320, 3)
    np.testing.assert_array_equal(rerun_log._smaller(small), small)
    large = np.kron(small, np.ones((9, 9, 1), np.uint8))
    np.testing.assert_array_equal(rerun_log._smaller(large), small)


def test_joints_have_names():
    assert joint_names(7) == [*(f"joint_{i}" for i in range(1, 7)), "gripper"]
    assert joint_names(14)[6:8] == ["left/gripper", "right/joint_1"]


def test_lessons_are_not_shown(tmp_path, capsys):
    words = ["--task", "press", "--teach", "hand", "--record", str(tmp_path / "data")]
    assert real([*words, "--rerun", str(tmp_path / "films")]) == 2
    assert "--rerun shows what a policy does" in capsys.readouterr().err
    assert not (tmp_path / "films").exists()
