"""A published base and a finished run, shared by all tests of a process."""

import dataclasses
import json

import pytest

from lorasp_jax import models
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.training import export
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, make_run


def write_base(folder):
    """Write a backbone with statistics of a robot with six joints and a gripper."""
    models.save(folder, random_backbone(Pi0Config.dummy()))
    moments = {"mean": [0.5] * 7, "std": [2.0] * 7}
    stats = {f"{kind}_{k}": v for kind in ("state", "action") for k, v in moments.items()}
    (folder / "statistics.json").write_text(json.dumps(stats))
    return folder


def finish_run(folder, base):
    """Write a finished run on a base; return its `Run`."""
    model_config = dataclasses.replace(CONFIG.model, checkpoint=str(base))
    run = make_run(folder, dataclasses.replace(CONFIG, model=model_config), models.load(base))
    run.base_hash = models.weights_hash(base)
    export.write(run)
    return run


@pytest.fixture(scope="session")
def dummy_base(tmp_path_factory):
    """Folder of a backbone with statistics of a robot with six joints and a gripper."""
    return write_base(tmp_path_factory.mktemp("base"))


@pytest.fixture(scope="session")
def finished(tmp_path_factory, dummy_base):
    """A finished `Run`."""
    return finish_run(tmp_path_factory.mktemp("runs") / "trained", dummy_base)
