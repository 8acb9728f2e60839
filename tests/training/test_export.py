"""What a run hands on can be loaded again and is the same."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from lorasp_jax import adaptation, adapter_io, models
from lorasp_jax.config import ModelConfig
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.policy import Policy
from lorasp_jax.models.processing import Statistics
from lorasp_jax.peft import FullFineTuning
from lorasp_jax.training import base, export, setup
from tests.runs import CONFIG, leaves, make_run, random_episodes
from tests.test_docs import BLOCK, ROOT


def moved(run):
    """The run with every trainable number changed, as training would."""
    graphdef, adapters, frozen = adaptation.split(run.policy.model)
    keys = iter(jax.random.split(jax.random.key(0), 1000))
    adapters = jax.tree.map(lambda x: x + 0.1 * jax.random.normal(next(keys), x.shape), adapters)
    run.policy = Policy(nnx.merge(graphdef, adapters, frozen), run.policy.processor)
    return run


@pytest.mark.slow
def test_adapters(tmp_path):
    run = moved(make_run(tmp_path / "run"))
    export.write(run)
    assert {path.name for path in run.folder.iterdir()} == {"adapter.safetensors", "adapter.json"}
    metadata = json.loads((run.folder / "adapter.json").read_text())["metadata"]
    assert (metadata["robot"], metadata["control_dt"]) == ("piper", 0.1)
    assert Statistics.from_json(json.dumps(metadata["statistics"]))
    bare = Pi0Config.dummy().create(nnx.Rngs(0))
    loaded = adapter_io.load_adapters(run.folder, bare, base=run.base_hash)
    expected = leaves(adaptation.split(run.policy.model)[1])
    for name, value in leaves(adaptation.split(loaded)[1]).items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)
    with pytest.raises(ValueError, match="was trained on base"):
        adapter_io.load_adapters(run.folder, bare, base="another")


@pytest.mark.slow
def test_the_policy_of_the_page_on_datasets_is_the_run_s(tmp_path):
    base = Pi0Config.dummy().create(nnx.Rngs(0))
    models.save(tmp_path / "base", base)
    base = models.load(tmp_path / "base")
    model = dataclasses.replace(CONFIG.model, checkpoint=str(tmp_path / "base"))
    run = moved(make_run(tmp_path / "run", dataclasses.replace(CONFIG, model=model), base))
    run.base_hash = models.weights_hash(base)
    export.write(run)
    program: dict[str, Any] = {}
    page = ROOT / "docs" / "datasets.md"
    (code,) = [code for code in BLOCK.findall(page.read_text()) if "def load_policy" in code]
    exec(compile(code, str(page), "exec"), program)
    loaded = program["load_policy"](run.folder, 6, max_tokens=base.config.max_tokens)
    group = random_episodes("press", 0)
    seen = {"image": {name: x[:, 0] for name, x in group.image.items()}, "state": group.state[:, 0]}
    rows = np.array([0, 1, 3])
    found, expected = (
        policy.sample(jax.random.key(0), seen, rows, num_steps=2) for policy in (loaded, run.policy)
    )
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.slow
def test_base(tmp_path):
    config = dataclasses.replace(CONFIG, peft=FullFineTuning(), targets=(".*",))
    run = moved(make_run(tmp_path / "run", config))
    counts = adaptation.count(run.policy.model)
    assert counts.trainable == counts.total
    export.write(run)
    folder = run.folder / "base"
    loaded = models.load(folder, Pi0Config.dummy())
    expected = leaves(nnx.state(adaptation.merge(run.policy.model), nnx.Param))
    for name, value in leaves(nnx.state(loaded, nnx.Param)).items():
        np.testing.assert_array_equal(value, expected[name].astype(jnp.bfloat16).astype(np.float32))
    assert json.loads((folder / base.TRAINING).read_text()) == {
        "robot": "piper",
        "tasks": ["press", "pick_place"],
        "control_dt": 0.1,
        "physics_dt": 0.005,
    }


@pytest.mark.parametrize("path", sorted(Path("assets").glob("*_*")), ids=lambda path: path.name)
def test_shipped_bases_load_and_say_what_they_are(path):
    backbone, size = path.name.split("_")
    chosen = ModelConfig(backbone=backbone, size=size, dtype="bfloat16")
    model, base_hash = setup.base_model(dataclasses.replace(CONFIG, model=chosen))
    assert base_hash == models.weights_hash(path)
    assert f"{adaptation.count(model).total:,} parameters" in (path / "README.md").read_text()
    assert model.config.dtype == "bfloat16"


def test_all_assets_are_small_enough_to_ship():
    assert len(list(Path("assets").glob("*_*"))) == 4
    assert sum(f.stat().st_size for f in Path("assets").rglob("*") if f.is_file()) < 48e6
