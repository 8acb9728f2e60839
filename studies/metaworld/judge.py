"""Judge a run's policy in Meta-World, which another Python environment has."""

import contextlib
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lorasp_jax.adapters import adaptation
from lorasp_jax.training.run import Run
from lorasp_jax.training.run_folder import read_metrics
from studies.metaworld.tasks import SETS

PYTHON = "METAWORLD_PYTHON"
"""Environment variable with the Python in which metaworld is installed."""
PROCESSES = 4
"""Processes that judge a policy."""
POLL = 1.0
"""Time between two looks at a judge and its server [s]."""


def judge(tasks: str, episodes: int, first_seed: int, run: Run) -> dict[str, Any]:
    """Serve and judge the policy of a run.

    Args:
        tasks: a key of `SETS`.
        episodes: per task; 0: do not judge.
        first_seed: seed of the first episode.
        run: a run whose policy is exported.

    Returns:
        `outcomes` by task, and what cells have otherwise: `active_rank` by module, of the last
        training batches, and numbers of parameters.

    Raises:
        ValueError: the server or the judge failed.
    """
    outcomes = {}
    if episodes:
        out = run.folder / "judged.json"
        out.unlink(missing_ok=True)  # left by a judge whose cell was killed
        options = [*("--tasks", *SETS[tasks]), *("--episodes", str(episodes))]
        options += ["--seed", str(first_seed), "--processes", str(PROCESSES), "--out", str(out)]
        _run(run.folder, options)
        judged = json.loads(out.read_text())["tasks"]
        outcomes = {n: "".join(str(int(o)) for o in t["outcomes"]) for n, t in judged.items()}
    last = read_metrics(run.folder)[-1]
    ranks = {key.split("/")[1]: value for key, value in last.items() if _is_rank(key)}
    trainable, total = adaptation.count(run.policy.model)
    sizes = {"trainable_parameters": trainable, "total_parameters": total}
    return {"outcomes": outcomes, "active_rank": ranks, **sizes}


def _run(folder: Path, options: list[str]) -> None:
    """Serve a policy, and judge it with some options."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = [sys.executable, "-m", "lorasp_jax.extras.serving", str(folder)]
    server += ["--port", str(port), "--seed", "0", "--max-batch", str(PROCESSES)]
    where = ["--server", f"ws://127.0.0.1:{port}", "--wait", "600"]
    python = os.environ.get(PYTHON, "")
    client = [python, "-m", "lorasp_jax.extras.judge", *where]
    client += ["--env", "studies.metaworld.world:mt50", *options]
    with (
        _process(server) as serving,
        _process(client) as judging,
    ):
        while judging.poll() is None:
            _check("serving", serving.poll() or 0)
            time.sleep(POLL)
        _check("judging", judging.returncode)


@contextlib.contextmanager
def _process(command: list[str]) -> Iterator[subprocess.Popen]:
    """Start a process, whose output goes where this one's does; end it after this block."""
    if not command[0]:
        raise ValueError(f"the variable {PYTHON} must name the Python that has metaworld")
    # The cell's process has taken its share of the device's memory.
    process = subprocess.Popen(command, env=os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"})
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


def _check(what: str, code: int) -> None:
    if code:
        raise ValueError(f"{what} failed with exit code {code}: see the cell's log")


def _is_rank(key: str) -> bool:
    """Say whether a metric is the active rank of a module, not of a layer."""
    return key.startswith("active_rank/") and key.count("/") == 1
