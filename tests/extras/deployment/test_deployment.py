"""Test variants, their table and the command on a run with a tiny backbone, without simulation."""

import dataclasses
import json
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax import models
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.compress import quantization
from lorasp_jax.extras.deployment import __main__ as command
from lorasp_jax.extras.deployment import measurement, variants
from lorasp_jax.extras.serving import loading
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import LoRA
from lorasp_jax.training import export
from lorasp_jax.training.run_folder import read_json, to_json, write_json
from tests import ROOT
from tests.cases import mostly_slow
from tests.extras.study.updates import add_noise
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, RESULTS, make_run, random_episodes

RANK = CONFIG.peft.rank


def finished_run(folder, base, method=CONFIG.peft):
    options = dataclasses.replace(CONFIG.model, checkpoint=str(base))
    config = dataclasses.replace(CONFIG, model=options, peft=method, tasks=("press",))
    run = make_run(folder, config, models.load(base))
    run.policy = dataclasses.replace(run.policy, model=add_noise(run.policy.model, 0.1))
    run.base_hash = models.weights_hash(base)
    export.write(run)
    write_json(folder / "config.json", to_json(config))
    write_json(folder / "results.json", RESULTS)
    return folder


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    folder = tmp_path_factory.mktemp("base")
    models.save(folder, random_backbone(Pi0Config.dummy()))
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory, base):
    return finished_run(tmp_path_factory.mktemp("runs") / "trained", base)


@pytest.fixture(autouse=True)
def episodes(monkeypatch):
    """Replace the simulation and shrink the batches."""
    monkeypatch.setattr(variants, "BATCHES", 1)
    monkeypatch.setattr(measurement, "BATCHES", 1)
    fake = lambda config, generation: {t: random_episodes(t, generation) for t in config.tasks}  # noqa: E731
    monkeypatch.setattr(measurement, "fresh_demonstrations", fake)


def actions(policy):
    obs = {
        "image": {name: jnp.ones((1, 32, 32, 3), jnp.uint8) for name in ("side", "wrist")},
        "state": jnp.zeros((1, 7)),
    }
    sample = jax.jit(lambda policy: policy.sample(jax.random.key(0), obs, jnp.zeros(1, jnp.int32)))
    return np.asarray(sample(policy))


def outcome(text):
    return {"success": text.count("1") / len(text), "outcomes": text}


def refuse(capsys, *arguments):
    assert command.main([str(argument) for argument in arguments]) == 2
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    assert len(printed.out) == 0
    return " ".join(printed.err.split())


def test_table(run, monkeypatch):
    """Outcomes 1101 and 1001 differ by one episode of four."""
    monkeypatch.setattr(measurement.cost, "call_milliseconds", lambda *_: 1.5)
    outcomes, episodes = iter(["1101", "1001"]), []

    def evaluate(policy, config, task, count):
        episodes.append((task, count))
        return outcome(next(outcomes))

    found = measurement.measure(run, ["half-nf4"], 4, evaluate=evaluate)
    assert found == read_json(run / measurement.FILE)
    assert episodes == [("press", 4)] * 2
    whole, half = (found["variants"][name] for name in ("whole-bf16", "half-nf4"))
    assert whole["difference"] == [0, 0, 0]
    assert half["difference"][0] == -0.25
    assert half["difference"][1] < -0.25 < half["difference"][2]
    assert 0 < whole["loss"] != half["loss"] > 0
    text = measurement.table(found).splitlines()
    assert len(text) == 4
    assert text[3].startswith("| half-nf4 | 50.0 % (")
    assert "| -25.0 (" in text[3]
    assert text[3].endswith("| 1.5 ms |")


@pytest.mark.slow
def test_table_of_all_variants(run):
    found = measurement.measure(run, episodes=4, evaluate=lambda *_: outcome("1101"))
    assert list(found["variants"]) == list(variants.VARIANTS)
    rows = found["variants"]
    size = {name: row["bytes"] for name, row in rows.items()}
    assert size["merged-bf16"] < size["half-bf16"] < size["whole-bf16"]
    assert size["whole-nf4"] < size["whole-int8"] < size["whole-bf16"]
    assert all(row["milliseconds"] > 0 and 0 < row["loss"] < 100 for row in rows.values())
    assert rows["whole-bf16"]["loss"] == pytest.approx(rows["whole-int8"]["loss"], rel=0.1)
    assert len({row["loss"] for row in rows.values()}) > 4


def test_forms(run):
    policy, _, settings = measurement.load(run)
    calibration = measurement.calibration_episodes(settings)
    forms = {form: variants.in_form(policy, form, calibration) for form in variants.FORMS}
    ranks = {
        form: {method.rank for method in adaptation.methods(forms[form].model).values()}
        for form in forms
    }
    assert (ranks["whole"], ranks["half"], ranks["merged"]) == ({RANK}, {RANK // 2}, set())
    assert max(ranks["pruned"]) <= RANK
    assert {leaf.dtype for leaf in jax.tree.leaves(forms["merged"].model)} == {
        jnp.dtype("bfloat16")
    }
    np.testing.assert_allclose(actions(forms["whole"]), actions(policy), atol=1e-2)
    assert not quantization.is_quantized(forms["whole"].model)


@pytest.mark.parametrize(
    "name", mostly_slow(["half-int8", "merged-bf16", "merged-nf4"], ["merged-nf4"])
)
def test_a_saved_variant_is_served(run, tmp_path, capsys, name):
    out = tmp_path / "policy"
    assert command.main([str(run), "--save", name, "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"written: {out}\n"
    loaded = loading.load_run(str(out))
    assert loaded.metadata == {"robot": "piper", "control_dt": 0.1}
    served = loaded.policy
    policy, _, settings = measurement.load(run)
    form, kind = name.split("-")
    made = variants.in_form(policy, form, measurement.calibration_episodes(settings))
    made = variants.on_base(made, kind)
    assert quantization.is_quantized(served.model) == (kind != "bf16")
    assert measurement.weight_bytes(served) == measurement.weight_bytes(made)
    np.testing.assert_allclose(actions(served), actions(made), atol=1e-5)
    assert np.abs(actions(served) - actions(policy)).max() > 1e-4


def test_refusals(run, base, tmp_path, capsys):
    out = tmp_path / "policy"
    save = run, "--save", "half-bf16", "--out"
    (tmp_path / "taken").mkdir()
    assert "taken exists already: choose another --out" in refuse(capsys, *save, tmp_path / "taken")
    unknown = refuse(capsys, run, "--save", "third", "--out", out)
    assert "unknown variant 'third': choose one of whole-bf16, whole-int8" in unknown
    assert "unknown variant 'third'" in refuse(capsys, run, "--variants", "third")
    assert "--save and --out must be given together" in refuse(capsys, run, "--save", "half-bf16")
    assert "are for measuring" in refuse(capsys, *save, out, "--episodes", "4")
    unfinished = refuse(capsys, tmp_path, *save[1:], out)
    assert f"{tmp_path} contains no policy: no run has finished there" in unfinished
    lora = finished_run(tmp_path / "lora", base, LoRA(rank=2))
    error = refuse(capsys, lora, *save[1:], out)
    assert "was trained with LoRA: only LoRA-SP runs have variants" in error
    assert not out.exists()


def test_a_run_needs_its_config_and_results(base, tmp_path, capsys):
    run = finished_run(tmp_path / "run", base)
    write_json(run / "results.json", RESULTS | {"tasks": {}})
    assert f"the tasks of {run} cannot be simulated" in refuse(capsys, run)
    (run / "results.json").unlink()
    assert f"{run} is not a finished run" in refuse(capsys, run)


def test_wrong_episodes_are_refused(run):
    def evaluate(*_):
        return outcome("10" * 64)

    with pytest.raises(ValueError, match="success depends on bit 0"):
        measurement.measure(run, ["whole-bf16"], evaluate=evaluate)


def test_quantized_base_of_a_policy_is_checked(run, tmp_path):
    (policy, *_), kind = measurement.load(run), cast(Any, "int2")
    export.write_variant(tmp_path / "x", policy, run, quantized=kind)
    with pytest.raises(ValueError, match="'int8' or 'nf4'"):
        export.load_policy(tmp_path / "x")


def test_docs_show_the_committed_tables():
    found = json.loads((ROOT / "docs" / "deployment.json").read_text())
    page = (ROOT / "docs" / "deployment.md").read_text()
    assert len(found) == 2
    for each in found.values():
        assert measurement.table(each) in page
