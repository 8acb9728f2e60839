"""The commands of docs/launch.md on a one-node Slurm cluster that this test starts.

Install the Debian packages slurmctld, slurmd, slurm-client and munge.
"""

import contextlib
import getpass
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from lorasp_jax.training.run_folder import read_metrics
from tests.several import ROOT

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "scancel", "scontrol")
MISSING = [name for name in PROGRAMS if not shutil.which(name)]
STEPS = 40
UNFINISHED = ("PENDING", "RUNNING", "COMPLETING")
OPTIONS = (
    *("--config", "configs/multitask.py", "--scale", "smoke", "--tasks", "press"),
    *("--optim.steps", str(STEPS), "--log-every", "1", "--checkpoint-every", "1000"),
    *("--data.episodes", "2", "--data.num-envs", "2", "--targets", "paper"),
    *("--evaluation.episodes", "2", "--evaluation.num-envs", "2"),
)
SIZES = ("--nodes=1", "--ntasks-per-node=2", "--gpus-per-node=2", "--cpus-per-task=1")
CONFIG = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser={user}
SlurmdUser={user}
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SlurmdParameters=config_overrides
SelectType=select/cons_tres
GresTypes=gpu
NodeName=localhost NodeHostname={host} NodeAddr=127.0.0.1 CPUs=2 Gres=gpu:2
PartitionName=all Nodes=ALL Default=YES
"""


def free_ports(count):
    with contextlib.ExitStack() as stack:
        taken = [stack.enter_context(socket.create_server(("", 0))) for _ in range(count)]
        return [one.getsockname()[1] for one in taken]


@contextlib.contextmanager
def running(*command, environment):
    """Run a daemon for the duration of the block."""
    null = subprocess.DEVNULL
    with subprocess.Popen(command, env=environment, stdout=null, stderr=null) as process:
        try:
            yield
        finally:
            process.terminate()


@pytest.fixture
def slurm(tmp_path):
    """Return a function that runs a Slurm command in a working copy and returns its output."""
    folder = tmp_path / "slurm"
    for name in ("state", "spool"):
        (folder / name).mkdir(parents=True)
    folder.chmod(0o755)  # so that munged's socket is reachable
    key = folder / "munge.key"
    key.write_bytes(os.urandom(64))
    key.chmod(0o400)
    host = socket.gethostname().partition(".")[0]
    values = {"host": host, "user": getpass.getuser(), "folder": folder, "ports": free_ports(2)}
    (folder / "slurm.conf").write_text(CONFIG.format(**values))
    (folder / "gres.conf").write_text("Name=gpu File=/dev/null\nName=gpu File=/dev/zero\n")
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "SLURM_CONF": str(folder / "slurm.conf"),
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": "--xla_force_host_platform_device_count=1",
        "JAX_COORDINATOR_PORT": str(free_ports(1)[0]),  # otherwise derived from the job id
    }
    for name in ("train.py", "configs"):
        (tmp_path / name).symlink_to(ROOT / name)

    def run(*command, **changes):
        done = subprocess.run(  # noqa: PLW1510
            command, env=environment | changes, cwd=tmp_path, text=True, capture_output=True
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    munged = ["munged", "--foreground", "--force", f"--key-file={key}"]
    munged += [f"--{what}-file={folder}/munge.{what}" for what in ("log", "pid", "seed")]
    munged.append(f"--socket={folder}/munge.socket")
    with (
        running(*munged, environment=environment),
        running("slurmctld", "-D", environment=environment),
        running("slurmd", "-D", "-N", "localhost", environment=environment),
    ):
        yield run


def page():
    """Return the page's `job.sh` and its commands by name."""
    text = (ROOT / "docs/launch.md").read_text()
    blocks = re.findall(r"^```\w*\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    job = next(block for block in blocks if "srun" in block and "--distributed" in block)
    lines = next(block for block in blocks if "scancel" in block).splitlines()
    return job, {line.split()[0]: line.partition("#")[0].split() for line in lines}


def wait_for(condition, seconds=1500):
    """Poll until the condition is true; return its value."""
    end = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < end, condition
        time.sleep(0.2)
    return value


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}")
def test_a_run_under_slurm_resumes_and_equals_one_process(slurm, tmp_path):
    job, commands = page()
    (tmp_path / "job.sh").write_text(job)
    whole, folder = (tmp_path / "runs" / name for name in ("whole", "slurm"))
    two = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    slurm("python", "train.py", *OPTIONS, "--name", "whole", **two)

    def job_field(name):
        return lambda: re.search(rf"{name}=(\S+)", slurm("scontrol", "show", "job", job_id))[1]

    submit = commands["sbatch"][:2]
    wait_for(lambda: "idle" in slurm("sinfo", "--noheader"))
    sbatch = [submit[0], *SIZES, f"--output={tmp_path}/log", *submit[1:]]
    job_id = slurm(*sbatch, *OPTIONS, "--name", "slurm").split()[-1]
    command = lambda name: [word.replace("JOBID", job_id) for word in commands[name]]  # noqa: E731
    ended = lambda: job_field("JobState")() not in UNFINISHED  # noqa: E731
    wait_for(lambda: read_metrics(folder) or ended())
    slurm(*command("scancel"))
    wait_for(lambda: job_field("JobState")() == "FAILED")
    assert job_field("ExitCode")() == "130:0"
    log = (tmp_path / "log").read_text()
    assert "waiting for 2 processes at localhost:" in log
    assert "stopped; to resume: python train.py --distributed --resume auto" in log
    assert 0 < len(read_metrics(folder)) < STEPS
    slurm(*command("scontrol"))
    # slurmd does not restart a job within the second in which it was killed
    slurm("scontrol", "update", f"jobid={job_id}", "StartTime=now+5")
    wait_for(ended)
    assert job_field("JobState")() == "COMPLETED", (tmp_path / "log").read_text()
    assert job_field("Restarts")() == "1"
    assert not re.search("Traceback|fatal errors", (tmp_path / "log").read_text())
    assert_same(folder, whole)


def assert_same(found, expected):
    """Compare up to rounding: sums over a batch are in another order."""
    rows = [[row["task"] for row in read_metrics(folder)] for folder in (found, expected)]
    assert len(rows[0]) == STEPS
    np.testing.assert_allclose(*rows, rtol=1e-3)
    results = [json.loads((folder / "results.json").read_text()) for folder in (found, expected)]
    assert results[0]["trainable_parameters"] == results[1]["trainable_parameters"]
    one, other = (load_file(folder / "adapter.safetensors") for folder in (found, expected))
    assert one.keys() == other.keys()
    for name, value in other.items():
        np.testing.assert_allclose(one[name], value, atol=1e-3 * abs(value).max(), err_msg=name)
