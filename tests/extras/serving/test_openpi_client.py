"""Test openpi's client, unmodified, in an environment of its own, because it needs NumPy 1."""

import dataclasses
import json
import subprocess
from pathlib import Path

import jax
import numpy as np
import pytest

from lorasp_jax.models.inputs import OPENPI
from lorasp_jax.models.pi0 import Pi0Config
from tests import foreign
from tests.extras.serving.stand_in import serving
from tests.extras.serving.test_policies import compiled, make_policy
from tests.extras.serving.test_requests import EXAMPLES

pytestmark = pytest.mark.slow

CAMERAS = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")
CONFIG = dataclasses.replace(
    Pi0Config.dummy(), cameras=CAMERAS, inputs=OPENPI, chunk=10, action_dim=16, max_tokens=32
)
"""A small pi0 with openpi's cameras and conventions."""


@pytest.fixture(scope="module")
def python():
    """Yield the interpreter of an environment with openpi's client."""
    # The client imports typing_extensions, which it does not declare.
    with foreign.environment("openpi-client==0.1.2", "typing_extensions") as python:
        yield python


@pytest.mark.parametrize(
    ("dims", "shapes", "token"),
    [(8, {"LIBERO": [10, 7], "DROID": [10, 8]}, ""), (14, {"ALOHA": [10, 14]}, "secret")],
)
def test_openpi_client(python, dims, shapes, token):
    policy = compiled({"base": make_policy(CONFIG, dims=dims)}, max_batch=1)
    policy.warm_up()
    sent = {
        form: jax.tree.map(lambda value: list(np.shape(value)), EXAMPLES[form]) for form in shapes
    }
    with serving(policy, token=token) as server:
        script = Path(__file__).with_name("openpi_script.py")
        command = [python, script, str(server.port), token, json.dumps(sent)]
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
