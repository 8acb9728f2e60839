"""Exported policies, written once for all tests of a process."""

import pytest

from lorasp_jax.extras.serving import exported
from lorasp_jax.extras.serving.exporting import write
from tests.extras.serving.test_policies import STEPS, make_policy

ROBOT = {"robot": "piper", "control_dt": 0.1}


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """An exported policy that can continue chunks, for one and two observations."""
    folder = tmp_path_factory.mktemp("exports") / "base"
    write(make_policy(), folder, continues=True, num_steps=STEPS, max_batch=2, metadata=ROBOT)
    return folder


@pytest.fixture(scope="session")
def other_folder(tmp_path_factory):
    """An exported policy of other weights and statistics that cannot continue chunks."""
    folder = tmp_path_factory.mktemp("exports") / "other"
    write(make_policy(seed=1), folder, num_steps=STEPS, max_batch=1, metadata=ROBOT)
    return folder


@pytest.fixture(scope="session")
def loaded(folder):
    return exported.load(folder)
