"""A fake arm on which the client's loop runs, and a finished run."""

import dataclasses
import json

import pytest

from lorasp_jax import models
from lorasp_jax.extras.piper.fake.world import World
from lorasp_jax.extras.piper.safety import Limits
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.training import export
from tests.extras.piper.benches import Bench
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, make_run


@pytest.fixture(scope="module")
def world():
    return World("press", image_size=16)


@pytest.fixture
def bench(world):
    bench = Bench(world).ready(Limits.of())
    yield bench
    bench.close()


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    folder = tmp_path_factory.mktemp("base")
    models.save(folder, random_backbone(Pi0Config.dummy()))
    moments = {"mean": [0.5] * 7, "std": [2.0] * 7}
    stats = {f"{kind}_{k}": v for kind in ("state", "action") for k, v in moments.items()}
    (folder / "statistics.json").write_text(json.dumps(stats))
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory, base):
    model_config = dataclasses.replace(CONFIG.model, checkpoint=str(base))
    config = dataclasses.replace(CONFIG, model=model_config)
    run = make_run(tmp_path_factory.mktemp("runs") / "trained", config, models.load(base))
    run.base_hash = models.weights_hash(base)
    export.write(run)
    return run.folder
