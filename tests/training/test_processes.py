"""Several processes train as one does, and only the first one writes."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from jax.sharding import PartitionSpec as P

from lorasp_jax.training import mesh as meshes
from lorasp_jax.training import processes
from tests.runs import repeatable

ROOT = Path(__file__).parents[2]
NAMES = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")


def start(folder, count, streams):
    """`count` processes, of four devices together, in one folder."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    flags = f"--xla_force_host_platform_device_count={4 // count}"
    everyone = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    for number in range(count):
        own = zip(NAMES, (address, str(count), str(number)), strict=True) if count > 1 else ()
        command = [sys.executable, "-m", "tests.training.together", folder, str(streams)]
        yield subprocess.Popen(command, env=everyone | dict(own), cwd=ROOT)


@pytest.mark.slow
@pytest.mark.parametrize("streams", [False, True])
def test_two_processes_train_as_one(streams, tmp_path):
    """Stopped by a signal to one of them, and resumed."""
    folders = {count: tmp_path / str(count) for count in (1, 2)}
    for count, folder in folders.items():
        codes = [process.wait() for process in list(start(folder, count, streams))]
        assert codes == [0] * count
        assert (folder / "ended").exists()
        assert len(list((folder / "tensorboard").iterdir())) == 2
    one, two = map(repeatable, folders.values())
    assert [row["step"] for row in two] == [2, 4]
    for expected, found in zip(one, two, strict=True):
        for name, value in expected.items():
            assert found[name] == pytest.approx(value, rel=1e-5), name


def test_alone_nothing_is_waited_for():
    processes.wait("name")
    processes.wait("name")
    with processes.first_goes_ahead("name"):
        assert processes.is_first()
    assert [processes.anywhere(flag) for flag in (True, False)] == [True, False]
    tree = {"a": np.ones(8), "b": np.ones(3)}
    mesh = meshes.make_mesh(2)
    placed = processes.put(tree, meshes.shardings(tree, mesh, minimum=1))
    assert [placed[name].sharding.spec for name in tree] == [P("fsdp"), P()]
    assert processes.own(placed) is placed


def test_nobody_there_is_one_sentence(monkeypatch):
    for name in NAMES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(
        jax.distributed, "initialize", lambda **_: (_ for _ in ()).throw(ValueError("no address"))
    )
    before = jax.config.jax_cpu_collectives_implementation
    with pytest.raises(ValueError, match="found no other processes: start it by Slurm") as caught:
        processes.initialize()
    jax.config.update("jax_cpu_collectives_implementation", before)
    assert "\n" not in str(caught.value)
    monkeypatch.setenv("JAX_PROCESS_ID", "second")
    with pytest.raises(ValueError, match="JAX_PROCESS_ID"):
        processes.initialize()
    jax.config.update("jax_cpu_collectives_implementation", before)
