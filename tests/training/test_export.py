"""What a run hands on can be loaded again and is the same."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from lorasp_jax import models
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import native
from lorasp_jax.base import hub
from lorasp_jax.base.digest import with_digest
from lorasp_jax.config import ModelConfig
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import FullFineTuning, LoRA
from lorasp_jax.policies import tokenizer
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training import base, export
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, leaves, make_run

BASES = sorted(path.parent for path in Path("assets").glob("*/config.json"))
FAST = dataclasses.replace(CONFIG, peft=LoRA(rank=4), targets=("action_out_proj",))
"""Where the method does not matter."""
SPARSE = dataclasses.replace(CONFIG, targets=("patch_embed", "language/blocks/q_proj"))
FULL = dataclasses.replace(CONFIG, peft=FullFineTuning())


def with_random_adapters(policy):
    """Return the policy with random adapters, whose values bf16 represents exactly."""
    graphdef, adapters, frozen = adaptation.split(policy.model)
    rng = np.random.default_rng(0)
    randomize = lambda x: jnp.asarray(rng.integers(-8, 8, x.shape) / 16, x.dtype)  # noqa: E731
    return Policy(nnx.merge(graphdef, jax.tree.map(randomize, adapters), frozen), policy.processor)


def run_on_a_base(folder, config=FAST):
    """Make a run in `folder`/run on a base in `folder`/base."""
    models.save(folder / "base", random_backbone(Pi0Config.dummy()))
    model_config = dataclasses.replace(config.model, checkpoint=str(folder / "base"))
    config = dataclasses.replace(config, model=model_config)
    run = make_run(folder / "run", config, models.load(folder / "base"))
    run.base_hash = models.weights_hash(folder / "base")
    return run


@pytest.mark.parametrize("config", [SPARSE, FULL], ids=["adapters", "base"])
def test_a_policy_loads(tmp_path, config):
    run = run_on_a_base(tmp_path, config)
    run.policy = with_random_adapters(run.policy)
    with pytest.raises(ValueError, match="contains no policy: no run has finished there"):
        export.load_policy(run.folder)
    export.write(run)
    described = export.describe(run.folder)
    assert (described["robot"], described["tasks"]) == ("piper", ["press", "pick_place"])
    assert (described["control_dt"], described["physics_dt"]) == (0.1, 0.005)
    loaded = export.load_policy(run.folder)
    found, expected = leaves(loaded.processor), leaves(run.policy.processor)
    assert found.keys() == expected.keys()
    for name, value in found.items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)
    assert jax.tree.structure(loaded.processor) == jax.tree.structure(run.policy.processor)
    found, expected = (leaves(nnx.state(x.model, nnx.Param)) for x in (loaded, run.policy))
    for name, value in found.items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)


@pytest.mark.parametrize("kind", ["shipped", "folder"])
def test_a_policy_loads_from_another_working_directory(tmp_path, monkeypatch, kind):
    """Where the base's relative path leads to another model."""
    if kind == "shipped":
        model_config = ModelConfig()
    else:
        monkeypatch.chdir(tmp_path)
        models.save("base", random_backbone(Pi0Config.dummy()))
        model_config = dataclasses.replace(CONFIG.model, checkpoint="base")
    model = models.load(model_config.source)
    run = make_run(tmp_path / "run", dataclasses.replace(FAST, model=model_config), model)
    run.base_hash = models.weights_hash(model)
    export.write(run)
    elsewhere = tmp_path / "elsewhere"
    models.save(elsewhere / model_config.source, random_backbone(Pi0Config.dummy(), seed=1))
    monkeypatch.chdir(elsewhere)
    monkeypatch.setattr(hub, "_from_hub", lambda *_: pytest.fail("the Hub was contacted"))
    loaded = export.load_policy(run.folder).model
    assert models.weights_hash(loaded) == run.base_hash


def test_the_error_for_a_missing_base_suggests_a_remedy(tmp_path, monkeypatch):
    export.write(run_on_a_base(tmp_path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "base").rename("moved")
    message = rf"^{tmp_path / 'base'} does not exist.*; pass base= if the base of .*run has moved$"
    with pytest.raises(ValueError, match=message):
        export.load_policy("run")
    assert export.load_policy("run", base="moved").model
    models.save("moved", random_backbone(Pi0Config.dummy(), seed=1))
    with pytest.raises(ValueError, match="another base"):
        export.load_policy("run", base="moved")
    assert export.load_policy("run", base="moved", any_base=True).model


@pytest.mark.parametrize("beside", [False, True])
def test_relative_actions_are_recorded_in_the_config_or_by_older_runs_beside_it(tmp_path, beside):
    run = run_on_a_base(tmp_path)
    export.write(run)
    facts = json.loads((run.folder / "adapter.json").read_text())
    policy, mask = facts["metadata"]["policy"], [*[True] * 6, False]
    assert "relative" not in policy
    if beside:
        policy["relative"] = mask
    else:
        policy["config"]["inputs"]["delta"] = mask
    del facts["digest"]
    (run.folder / "adapter.json").write_text(json.dumps(with_digest(facts)))
    loaded = export.load_policy(run.folder)
    assert [*loaded.processor.inputs.delta] == [*loaded.model.config.inputs.delta] == mask


def test_another_tokenizer_is_rejected(tmp_path, monkeypatch):
    run = run_on_a_base(tmp_path)
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


@pytest.mark.parametrize("path", BASES, ids=lambda path: path.name)
def test_bundled_bases_load_and_match_the_model_card(path):
    backbone, size = path.name.split("_")
    model_config = ModelConfig(backbone=backbone, size=size, dtype="bfloat16")
    model, base_hash = base.base_model(dataclasses.replace(CONFIG, model=model_config))
    assert base_hash == models.weights_hash(path)
    size = f"{adaptation.count(model).total:,} parameters"
    assert f"| `{path.name}` | {size}" in path.with_name("README.md").read_text()
    assert model.config.dtype == "bfloat16"


def test_assets_are_small():
    assert len(BASES) == 4
    assert sum(f.stat().st_size for f in Path("assets").rglob("*") if f.is_file()) < 48e6
