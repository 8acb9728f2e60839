"""Several processes train like a single one, and only the first one writes."""

import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from jax.sharding import PartitionSpec as P
from rich.console import Console

from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.distributed import processes
from tests import ROOT
from tests.runs import repeatable
from tests.several import NAMES, environments, start

WORKER = ("-u", "-m", "tests.training.worker")
WAITING = """
import sys, time
from rich.console import Console
from lorasp_jax.base.errors import run_command
from lorasp_jax.training.distributed import processes
from lorasp_jax.training.interrupt import sigterm_as_interrupt

def run():
    with sigterm_as_interrupt():
        print("connecting", flush=True)
        processes.initialize(Console())
        first = processes.is_first()
        print("ready", flush=True)
        if first and sys.argv[1:] == ["fails"]:
            raise ValueError("the expert failed")
        if first:
            time.sleep(1000)
        processes.barrier("collected")

processes.exit_all(run_command(run, Console(stderr=True)))
"""


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
@pytest.mark.parametrize("fails", [False, True])
def test_a_failed_process_ends_the_other_within_two_minutes(number, fails, tmp_path):
    """`fails`: by an uncaught error, which it prints; otherwise it is killed."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    own = {number: ("--fails", 3)} if fails else {}
    children = start(2, *WORKER, tmp_path / "run", "--steps", 40_000, own=own, **pipes)
    printed = {}
    for child in children:
        printed[child] = [line := child.stdout.readline()]
        while line not in ("", "step 3\n"):  # warnings of JAX may cut that line in two
            printed[child].append(line := child.stdout.readline())
    failed, other = children[number], children[1 - number]
    if not fails:
        failed.kill()
    assert other.communicate(timeout=120)
    output = "".join(printed[failed]) + failed.communicate(timeout=120)[0]
    assert failed.returncode
    assert other.returncode
    assert ("RuntimeError: nobody catches this" in output) == fails


@pytest.mark.slow
@pytest.mark.parametrize(
    ("own", "signaled", "code"),
    [((), (0, 1), 130), ((), (0,), 130), (("fails",), (), 2)],
)
def test_all_exit_alike_while_the_first_works_and_the_others_wait(own, signaled, code):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    children = start(2, "-u", "-c", WAITING, own={0: own}, **pipes)
    for child in children:
        while "ready" not in child.stdout.readline():
            pass
    for number in signaled:
        children[number].terminate()
    for child in children:
        child.communicate(timeout=50)  # JAX would abort them after 60 s
    assert [child.returncode for child in children] == [code, code]


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1])
def test_a_signal_ends_the_wait_for_other_processes(number):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    command = [sys.executable, "-u", "-c", WAITING]
    environment = [*environments(2)][number]
    with subprocess.Popen(command, env=environment, cwd=ROOT, **pipes) as child:
        assert child.stdout.readline() == "connecting\n"
        time.sleep(3)
        child.terminate()
        child.communicate(timeout=50)
    assert child.returncode == 130


def test_alone_errors_are_raised_as_they_are():
    processes.agree("settings", {"seed": 1})
    with pytest.raises(ValueError, match="wrong"), processes.together():
        raise ValueError("wrong")


def initialize(*environment, monkeypatch):
    """Initialize with these values of the variables; None: unset."""
    for name in NAMES:
        monkeypatch.delenv(name, raising=False)
    for name, value in zip(NAMES, environment, strict=True):
        if value is not None:
            monkeypatch.setenv(name, value)
    processes.initialize(Console())


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
