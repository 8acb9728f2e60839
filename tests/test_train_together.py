"""Test `train.py` in two processes: same results as in one, or a one-line error."""

import subprocess

import numpy as np
import pytest
from flax import nnx
from safetensors.numpy import load_file

from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.training.distributed import mesh as meshes
from tests.runs import repeatable
from tests.several import ROOT, start

COMMAND = (
    *(ROOT / "train.py", "--config", ROOT / "configs/multitask.py", "--scale", "smoke"),
    *("--tasks", "press", "--data.episodes", 2, "--data.num-envs", 2),
    *("--evaluation.episodes", 2, "--evaluation.num-envs", 2, "--optim.batch-size", 8),
)
SPLIT = (
    *("--model.size", "small", "--model.unroll", "False", "--method", "full", "--fsdp", 2),
    *("--targets", "action.*(gate_proj|down_proj)", "--optim.steps", 2, "--log-every", 1),
)


def wait(children):
    """Wait for the processes; return their exit codes and their (stdout, stderr)."""
    outputs = [child.communicate() for child in children]
    return [child.returncode for child in children], outputs


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_two_processes_match_one_on_simulated_tasks(tmp_path):
    """Base and trainable parameters are large enough to be sharded over both processes."""
    shapes = nnx.state(nnx.eval_shape(lambda: Pi0Config.small().create(nnx.Rngs(0))))
    assert meshes.bytes_on_device(shapes, fsdp=2) < meshes.bytes_on_device(shapes, fsdp=1)
    folders = []
    for count in (1, 2):
        options = (*COMMAND, *SPLIT, "--name", f"of{count}")
        joint = ("--distributed",) if count > 1 else ()
        codes, _ = wait(start(count, *options, *joint, devices=2 // count, cwd=tmp_path))
        assert codes == [0] * count
        folders.append(tmp_path / "runs" / f"of{count}")
    for expected, actual in zip(*map(repeatable, folders), strict=True):
        for name, value in expected.items():
            assert actual[name] == pytest.approx(value, rel=1e-4), name
    one, two = (load_file(next(folder.glob("base/*.safetensors"))) for folder in folders)
    assert one.keys() == two.keys()
    for name, value in one.items():
        expected, actual = (x.astype(np.float32) for x in (value, two[name]))  # from bfloat16
        atol = 1e-5 * abs(expected).max()
        np.testing.assert_allclose(actual, expected, rtol=2**-7, atol=atol, err_msg=name)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    ("own", "says", "reason"),
    [
        ({1: ("--seed", 5)}, 1, "process 1 has other settings than the first process (seed): use"),
        ({1: ("--resume", "auto")}, 1, "(resume): use the same ones in all processes"),
        ({1: ("--seed", "x")}, 1, "--seed"),
        ({}, 0, "error: runs/multitask already contains a run: add --resume"),
    ],
)
def test_one_process_says_what_is_wrong_and_both_exit(own, says, reason, tmp_path):
    (tmp_path / "runs/multitask").mkdir(parents=True)
    (tmp_path / "runs/multitask/metrics.jsonl").write_text("precious\n")
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    codes, outputs = wait(start(2, *COMMAND, "--distributed", own=own, cwd=tmp_path, **pipes))
    assert codes == [2, 2]
    assert outputs[0][0].startswith("waiting for 2 processes at 127.0.0.1:")
    errors = [[line for line in error.splitlines() if "[Gloo]" not in line] for _, error in outputs]
    assert reason in " ".join(errors[says])
    assert len(errors[says]) == 1 or "--seed" in reason
    assert errors[1 - says] == []
