"""Several processes train like a single one, and only the first one writes."""

import socket
import subprocess
import time

import numpy as np
import pytest
from jax.sharding import PartitionSpec as P
from rich.console import Console

from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.distributed import processes
from tests.runs import repeatable
from tests.several import NAMES, start

WORKER = ("-u", "-m", "tests.training.worker")


@pytest.mark.slow
@pytest.mark.parametrize("streams", [False, True])
def test_two_processes_train_as_one(streams, tmp_path):
    """Including a stop by a signal to one of them, and a resume."""
    folders = {count: tmp_path / str(count) for count in (1, 2)}
    for count, folder in folders.items():
        arguments = ("-m", "tests.training.together", folder, streams)
        children = start(count, *arguments, devices=4 // count)
        assert [child.wait() for child in children] == [0] * count
        assert (folder / "ended").exists()
        assert len(list((folder / "tensorboard").iterdir())) == 2
    one, two = map(repeatable, folders.values())
    assert [row["step"] for row in two] == [2, 4]
    for expected, found in zip(one, two, strict=True):
        for name, value in expected.items():
            assert found[name] == pytest.approx(value, rel=1e-5), name


def test_barriers_and_placement_in_a_single_process():
    processes.barrier("name")
    processes.barrier("name")
    with processes.first_process_first("name"):
        assert processes.is_first()
    assert [processes.any_process(flag) for flag in (True, False)] == [True, False]
    tree = {"a": np.ones(8), "b": np.ones(3)}
    mesh = meshes.make_mesh(2)
    placed = processes.device_put(tree, meshes.shardings(tree, mesh, minimum=1))
    assert [placed[name].sharding.spec for name in tree] == [P("fsdp"), P()]
    assert processes.to_local(placed) is placed


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1])
def test_when_one_is_killed_the_last_line_of_the_other_mentions_resume(number, tmp_path):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    children = start(2, *WORKER, tmp_path / "run", "--steps", 4000, **pipes)
    for child in children:
        while child.stdout.readline() not in ("", "step 3\n"):
            pass
    killed, other = children[number], children[1 - number]
    killed.kill()
    start_time = time.monotonic()
    last = other.communicate(timeout=120)[0].splitlines()[-1]
    assert time.monotonic() - start_time < 60  # JAX would need 100 s
    assert other.returncode == 1
    assert "disconnected unexpectedly: it was killed" in last
    assert last.endswith("add --resume")
    killed.communicate()


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1])
def test_an_error_in_one_ends_the_other_in_seconds(number, tmp_path):
    """It does not wait for the other one, as JAX would, and prints nothing but the traceback."""
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    command = (*WORKER, tmp_path / "run", "--steps", 4000)
    children = start(2, *command, own={number: ("--fails", 3)}, **pipes)
    failed, other = children[number], children[1 - number]
    failed_errors = failed.communicate(timeout=400)[1]
    start_time = time.monotonic()
    other_errors = other.communicate(timeout=120)[1]
    assert time.monotonic() - start_time < 60  # 8 s on an idle machine; JAX would need 100 s
    assert [child.returncode for child in children] == [1, 1]
    assert failed_errors.endswith("RuntimeError: nobody catches this\n")
    lines = [line for line in other_errors.splitlines() if not line.startswith("compil")]
    assert len(lines) == (number == 1)
    assert number == 0 or lines[0].startswith("process 1 on ")


def initialize(*environment, monkeypatch):
    """Initialize with these values of the variables; None: unset."""
    for name in NAMES:
        monkeypatch.delenv(name, raising=False)
    for name, value in zip(NAMES, environment, strict=True):
        if value is not None:
            monkeypatch.setenv(name, value)
    processes.initialize(Console(), "add --resume")


@pytest.mark.parametrize(
    ("environment", "reason"),
    [
        ((None, None, None), "found no launcher: use Slurm.*no coordinator address"),
        (("10.0.0.1:1", None, "0"), "or set JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and"),
        (("10.0.0.1:1", "2", "second"), "JAX_PROCESS_ID .*'second'"),
        (("10.0.0.1:1", "2", "2"), "JAX_PROCESS_ID must be between 0 and 1, got 2"),
        (("localhost", "2", "0"), "must be host:port, such as 10.0.0.1:1234, got 'localhost'"),
        (("localhost", "2", "1"), "must be host:port, such as 10.0.0.1:1234, got 'localhost'"),
    ],
)
def test_an_invalid_environment_is_one_sentence(environment, reason, monkeypatch):
    with pytest.raises(ValueError, match=reason) as caught:
        initialize(*environment, monkeypatch=monkeypatch)
    assert "\n" not in str(caught.value)


def test_a_port_in_use_is_one_sentence(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(ValueError, match=r"port \d+ on .* not available .Address already in"):
            initialize(address, "2", "0", monkeypatch=monkeypatch)
