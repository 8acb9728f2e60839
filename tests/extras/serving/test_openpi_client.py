"""Test openpi's client, unmodified, in an environment of its own, because it needs NumPy 1."""

import dataclasses
import json
import subprocess

import numpy as np
import pytest

from lorasp_jax.extras.serving.policies import CompiledPolicy
from lorasp_jax.extras.serving.served import ServedPolicies
from lorasp_jax.models.inputs import OPENPI
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.policies import tokenizer
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.statistics import Statistics
from tests import ROOT, foreign
from tests.extras.serving.stand_in import serving
from tests.models.random_models import random_backbone

pytestmark = pytest.mark.slow

SCRIPT = ROOT / "tests" / "extras" / "serving" / "openpi_script.py"
CAMERAS = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")


@pytest.fixture(scope="module")
def python():
    """Yield the interpreter of an environment with openpi's client."""
    # The client imports typing_extensions, which it does not declare.
    with foreign.environment("openpi-client==0.1.2", "typing_extensions") as python:
        yield python


def policy(dims):
    """A small pi0 with openpi's cameras and conventions, for a robot of `dims` dimensions."""
    config = dataclasses.replace(
        Pi0Config.dummy(), cameras=CAMERAS, inputs=OPENPI, chunk=10, action_dim=16, max_tokens=32
    )
    moments = {"mean": np.zeros(dims, np.float32), "std": np.ones(dims, np.float32)}
    words = tokenizer.Offline()
    prompts = PromptTable.of(words, ["do something"], config, num_joints=dims - 1)
    processor = Processor.of(config, Statistics(moments, moments), prompts, num_joints=dims - 1)
    policy = Policy(random_backbone(config), processor)
    served = ServedPolicies({"base": CompiledPolicy(policy, words, max_batch=1, num_steps=2)})
    served.warm_up()
    return served


@pytest.mark.parametrize(
    ("dims", "shapes", "token"),
    [(8, {"LIBERO": [10, 7], "DROID": [10, 8]}, ""), (14, {"ALOHA": [10, 14]}, "secret")],
)
def test_openpi_client(python, dims, shapes, token):
    with serving(policy(dims), token=token) as server:
        command = [python, SCRIPT, str(server.port), token, *shapes]
        process = subprocess.run(command, check=False, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    results = [json.loads(line) for line in process.stdout.splitlines()]
    assert [result["form"] for result in results] == list(shapes)
    for result in results:
        assert result["numpy"].startswith("1.")
        assert result["shape"] == shapes[result["form"]]
        assert result["dtype"] == "float32"
        assert result["steps"] == [shapes[result["form"]][1:]] * 11
        assert result["timing"].keys() == {"infer_ms", "prev_total_ms"}
        assert result["metadata"]["cameras"] == list(CAMERAS)
        assert "keys of one of these forms" in result["error"]
