"""What a run hands on can be loaded again and is the same."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from lorasp_jax import models
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import native
from lorasp_jax.base.digest import with_digest
from lorasp_jax.config import ModelConfig
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import FullFineTuning
from lorasp_jax.policies import tokenizer
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Statistics
from lorasp_jax.training import base, export
from tests import ROOT
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, leaves, make_run

BASES = sorted(path.parent for path in Path("assets").glob("*/config.json"))


def perturbed(run):
    """Change every trainable parameter, as training would."""
    run.policy = with_random_adapters(run.policy)
    return run


def with_random_adapters(policy):
    """Return the policy with random adapters, whose values bf16 represents exactly."""
    graphdef, adapters, frozen = adaptation.split(policy.model)
    rng = np.random.default_rng(0)
    randomize = lambda x: jnp.asarray(rng.integers(-8, 8, x.shape) / 16, x.dtype)  # noqa: E731
    return Policy(nnx.merge(graphdef, jax.tree.map(randomize, adapters), frozen), policy.processor)


@pytest.mark.slow
def test_adapters(tmp_path):
    run = perturbed(make_run(tmp_path / "run"))
    export.write(run)
    assert {path.name for path in run.folder.iterdir()} == {"adapter.safetensors", "adapter.json"}
    metadata = json.loads((run.folder / "adapter.json").read_text())["metadata"]
    assert (metadata["robot"], metadata["control_dt"]) == ("piper", 0.1)
    assert Statistics.from_json(json.dumps(metadata["policy"]["statistics"]))
    base_model = random_backbone(Pi0Config.dummy())
    loaded = native.load_adapters(run.folder, base_model, base=run.base_hash)
    expected = leaves(adaptation.split(run.policy.model)[1])
    for name, value in leaves(adaptation.split(loaded)[1]).items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)
    with pytest.raises(ValueError, match="was trained on base"):
        native.load_adapters(run.folder, base_model, base="another")


@pytest.mark.parametrize("method", [CONFIG.peft, FullFineTuning()], ids=["adapters", "base"])
def test_a_policy_loads(tmp_path, method):
    models.save(tmp_path / "base", random_backbone(Pi0Config.dummy()))
    model_config = dataclasses.replace(CONFIG.model, checkpoint=str(tmp_path / "base"))
    config = dataclasses.replace(CONFIG, model=model_config, peft=method)
    run = make_run(tmp_path / "run", config, models.load(tmp_path / "base"))
    run.policy = with_random_adapters(run.policy)
    run.base_hash = models.weights_hash(tmp_path / "base")
    with pytest.raises(ValueError, match="contains no policy: no run has finished there"):
        export.load_policy(run.folder)
    export.write(run)
    loaded = export.load_policy(run.folder)
    found, expected = leaves(loaded.processor), leaves(run.policy.processor)
    assert found.keys() == expected.keys()
    for name, value in found.items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)
    assert jax.tree.structure(loaded.processor) == jax.tree.structure(run.policy.processor)
    found, expected = (leaves(nnx.state(x.model, nnx.Param)) for x in (loaded, run.policy))
    for name, value in found.items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)


ELSEWHERE = """
import sys, huggingface_hub
huggingface_hub.snapshot_download = lambda *_, **__: sys.exit("the Hub was contacted")
from lorasp_jax import models
from lorasp_jax.training.export import load_policy
print(models.weights_hash(load_policy(sys.argv[1]).model))
"""


@pytest.mark.parametrize("kind", ["shipped", "folder"])
def test_a_policy_loads_from_another_working_directory(tmp_path, monkeypatch, kind):
    """In a new process, where the base's relative path leads to another model."""
    if kind == "shipped":
        model_config = ModelConfig()
    else:
        monkeypatch.chdir(tmp_path)
        models.save("base", random_backbone(Pi0Config.dummy()))
        model_config = dataclasses.replace(CONFIG.model, checkpoint="base")
    model = models.load(model_config.source)
    run = make_run(tmp_path / "run", dataclasses.replace(CONFIG, model=model_config), model)
    run.base_hash = models.weights_hash(model)
    export.write(run)
    elsewhere = tmp_path / "elsewhere"
    models.save(elsewhere / model_config.source, random_backbone(Pi0Config.dummy(), seed=1))
    command = [sys.executable, "-c", ELSEWHERE, str(run.folder)]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    found = subprocess.run(
        command, check=False, cwd=elsewhere, env=env, capture_output=True, text=True
    )
    assert found.stdout.split() == [run.base_hash], found.stderr


def test_the_error_for_a_missing_base_suggests_a_remedy(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    models.save("base", random_backbone(Pi0Config.dummy()))
    model_config = dataclasses.replace(CONFIG.model, checkpoint="base")
    run = make_run(
        tmp_path / "run", dataclasses.replace(CONFIG, model=model_config), models.load("base")
    )
    run.base_hash = models.weights_hash("base")
    export.write(run)
    (tmp_path / "base").rename("moved")
    message = rf"^{tmp_path / 'base'} does not exist.*; pass base= if the base of .*run has moved$"
    with pytest.raises(ValueError, match=message):
        export.load_policy("run")
    assert export.load_policy("run", base="moved").model
    models.save("moved", random_backbone(Pi0Config.dummy(), seed=1))
    with pytest.raises(ValueError, match="another base"):
        export.load_policy("run", base="moved")
    assert export.load_policy("run", base="moved", any_base=True).model


def test_another_tokenizer_is_rejected(tmp_path, monkeypatch):
    models.save(tmp_path / "base", random_backbone(Pi0Config.dummy()))
    model_config = dataclasses.replace(CONFIG.model, checkpoint=str(tmp_path / "base"))
    config = dataclasses.replace(CONFIG, model=model_config)
    run = make_run(tmp_path / "run", config, models.load(tmp_path / "base"))
    export.write(run)
    encode = tokenizer.Offline.encode

    def other(self, texts, *args, **kwargs):
        ids, valid = encode(self, texts, *args, **kwargs)
        return np.where(valid, (ids + 1) % 300, 0), valid

    monkeypatch.setattr(tokenizer.Offline, "encode", other)
    with pytest.raises(ValueError, match=r"produces different tokens than .*: pass words="):
        export.load_policy(run.folder)


@pytest.mark.parametrize("changes", [{"policy": {}}, {"policy": {"backbone": "pi9"}}, {"base": ""}])
def test_an_incomplete_policy_is_rejected(tmp_path, changes):
    config = Pi0Config.dummy()
    metadata = {
        "base": "somewhere",
        "policy": {"backbone": "pi0", "config": dataclasses.asdict(config)},
    }
    facts = {"format": native.FORMAT, "version": native.VERSION, "metadata": metadata | changes}
    facts |= {"base": "", "weights": {}, "methods": {}, "sha256": ""}
    (tmp_path / "adapter.json").write_text(json.dumps(with_digest(facts)))
    with pytest.raises(ValueError, match=r"does not describe a policy|was random"):
        export.load_policy(tmp_path)


@pytest.mark.slow
def test_base(tmp_path):
    config = dataclasses.replace(CONFIG, peft=FullFineTuning(), targets=(".*",))
    run = perturbed(make_run(tmp_path / "run", config))
    counts = adaptation.count(run.policy.model)
    assert counts.trainable == counts.total
    export.write(run)
    folder = run.folder / "base"
    loaded = models.load(folder, Pi0Config.dummy())
    expected = leaves(nnx.state(adaptation.merge(run.policy.model), nnx.Param))
    for name, value in leaves(nnx.state(loaded, nnx.Param)).items():
        np.testing.assert_array_equal(value, expected[name].astype(jnp.bfloat16).astype(np.float32))
    training = json.loads((folder / base.TRAINING).read_text())
    assert (training["robot"], training["tasks"]) == ("piper", ["press", "pick_place"])
    assert (training["control_dt"], training["physics_dt"]) == (0.1, 0.005)


@pytest.mark.parametrize("path", BASES, ids=lambda path: path.name)
def test_bundled_bases_load_and_match_their_model_cards(path):
    backbone, size = path.name.split("_")
    model_config = ModelConfig(backbone=backbone, size=size, dtype="bfloat16")
    model, base_hash = base.base_model(dataclasses.replace(CONFIG, model=model_config))
    assert base_hash == models.weights_hash(path)
    assert f"{adaptation.count(model).total:,} parameters" in (path / "README.md").read_text()
    assert model.config.dtype == "bfloat16"


def test_assets_are_small():
    assert len(BASES) == 4
    assert sum(f.stat().st_size for f in Path("assets").rglob("*") if f.is_file()) < 48e6
