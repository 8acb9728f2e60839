"""Judge a run's policy in Meta-World, which another Python environment has."""

import asyncio
import json
import os
from collections.abc import Sequence
from typing import Any

from lorasp_jax.adapters import adaptation
from lorasp_jax.policies.tokenizer import load_tokenizer
from lorasp_jax.training.run import Run
from lorasp_jax.training.run_folder import read_metrics
from studies.metaworld.tasks import SETS

PYTHON = "METAWORLD_PYTHON"
"""Environment variable with the Python in which metaworld is installed."""
PROCESSES = 4
"""Processes that judge a policy."""


def judge(tasks: str, episodes: int, first_seed: int, run: Run) -> dict[str, Any]:
    """Judge the policy of a run.

    Args:
        tasks: a key of `SETS`.
        episodes: per task; 0: do not judge.
        first_seed: seed of the first episode.
        run: a run.

    Returns:
        `outcomes` by task, and what cells have otherwise: `active_rank` by module, of the last
        training batches, and numbers of parameters.

    Raises:
        ValueError: see `outcomes`.
    """
    found = outcomes(run, SETS[tasks], episodes, first_seed) if episodes else {}
    last = read_metrics(run.folder)[-1]
    parts = ((key.split("/"), value) for key, value in last.items())  # a layer's has three
    ranks = {key[1]: value for key, value in parts if key[0] == "active_rank" and len(key) == 2}
    trainable, total = adaptation.count(run.policy.model)
    sizes = {"trainable_parameters": trainable, "total_parameters": total}
    return {"outcomes": found, "active_rank": ranks, **sizes}


def outcomes(run: Run, tasks: Sequence[str], episodes: int, first_seed: int) -> dict[str, str]:
    """Serve the policy of a run from this process, and return its outcomes by task.

    Policies of equal shape share the programs that this process has compiled.

    Raises:
        ValueError: the judge failed, or its Python is not known.
    """
    if not (python := os.environ.get(PYTHON)):
        raise ValueError(f"the variable {PYTHON} must name the Python that has metaworld")
    out = run.folder / "judged.json"
    out.unlink(missing_ok=True)  # left by an earlier judge
    command = [python, "-m", "lorasp_jax.extras.judge", "--env", "studies.metaworld.world:mt50"]
    command += ["--tasks", *tasks, "--episodes", str(episodes), "--seed", str(first_seed)]
    command += ["--processes", str(PROCESSES), "--out", str(out)]
    if code := asyncio.run(_judged(run, command)):
        raise ValueError(f"judging failed with exit code {code}: see the cell's log")
    judged = json.loads(out.read_text())["tasks"]
    return {n: "".join(str(int(o)) for o in t["outcomes"]) for n, t in judged.items()}


async def _judged(run: Run, command: Sequence[str]) -> int:
    """Serve the policy of a run to a judge, a process; return its exit code."""
    from lorasp_jax.extras.serving import loading, policies, server  # optional dependencies
    from lorasp_jax.extras.serving.served import ServedPolicies

    steps, words = run.config.evaluation.denoise_steps, run.config.model.tokenizer
    loaded = loading.Loaded(run.policy, load_tokenizer(words), denoise_steps=steps)
    served = ServedPolicies({"run": policies.CompiledPolicy(loaded, max_batch=PROCESSES)})
    served.warm_up()
    port = server.bind("127.0.0.1", 0)
    serving = server.PolicyServer(served)
    try:
        async with serving.listen(port):
            url = f"ws://127.0.0.1:{port.getsockname()[1]}"
            judge = await asyncio.create_subprocess_exec(*command, "--server", url)
            try:
                return await judge.wait()
            finally:
                if judge.returncode is None:
                    judge.terminate()
                    await judge.wait()
    finally:
        serving.close()
