"""Test variants, their table and the command on a run with a tiny backbone, without simulation."""

import dataclasses
import itertools
import shutil
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
from lorasp_jax.extras.deployment.measurement import call_milliseconds
from lorasp_jax.extras.serving import loading
from lorasp_jax.extras.study import held_out, results, run_cell
from lorasp_jax.peft import LoRA, LoRAMoE
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.tokenizer import Offline
from lorasp_jax.training import export
from lorasp_jax.training.run_folder import to_json, write_json
from tests.cases import mostly_slow
from tests.extras.serving.test_policies import SIMULATED
from tests.runs import CONFIG, RESULTS, make_run, random_episodes
from tests.studies.paper.updates import add_noise

RANK, STEPS = CONFIG.peft.rank, 4
HELD_OUT = random_episodes("press", 0)
EPISODES = {"press": HELD_OUT}


def finished_run(folder, base, method=CONFIG.peft, instructions=None):
    """Write a run without its data, with instructions by task if they are given."""
    tasks = tuple(instructions or ("press",))
    options = dataclasses.replace(CONFIG.model, checkpoint=str(base))
    settings = {"peft": method, "tasks": tasks, "targets": ("action/blocks/q_proj",)}
    evaluation = dataclasses.replace(CONFIG.evaluation, denoise_steps=STEPS)
    config = dataclasses.replace(CONFIG, model=options, evaluation=evaluation, **settings)
    run = make_run(folder, config, models.load(base))
    processor = run.policy.processor
    if instructions:
        phrases, model = itertools.chain(*instructions.values()), run.policy.model.config
        prompts = PromptTable.of(Offline(), [*phrases], model, num_joints=6)
        processor = dataclasses.replace(processor, prompts=prompts)
    run.policy = Policy(add_noise(run.policy.model, 0.1), processor)
    run.base_hash = models.weights_hash(base)
    export.write(run)
    write_json(folder / "config.json", to_json(config))
    results_by_task = dict.fromkeys(tasks, RESULTS["tasks"]["press"])
    write_json(folder / "results.json", RESULTS | {"tasks": results_by_task})
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory, dummy_base):
    return finished_run(tmp_path_factory.mktemp("runs") / "trained", dummy_base)


@pytest.fixture(autouse=True)
def episodes(monkeypatch):
    """Replace the simulation and shrink the batches."""
    monkeypatch.setattr(variants, "BATCHES", 1)
    monkeypatch.setattr(measurement, "BATCHES", 1)
    monkeypatch.setattr(measurement, "call_milliseconds", lambda *_: 1.5)
    fake = lambda config, generation: {t: random_episodes(t, generation) for t in config.tasks}  # noqa: E731
    monkeypatch.setattr(measurement, "_other_demonstrations", fake)
    monkeypatch.setattr(
        held_out, "demonstrations", lambda config, *_: {t: HELD_OUT for t in config.tasks}
    )
    outcomes = iter(["1101", "1001"] * 6)

    def play(_, run):
        """Stand in for an evaluation."""
        after = {"success": 0.5, "episodes": 4, "ci95": [0, 1], "outcomes": next(outcomes)}
        tasks = {task: {"after": after} for task in run.config.tasks}
        write_json(run.folder / "results.json", RESULTS | {"tasks": tasks})

    monkeypatch.setattr(run_cell.Evaluation, "on_end", play)


@jax.jit
def actions(policy):
    obs = {
        "image": {name: jnp.ones((1, 32, 32, 3), jnp.uint8) for name in ("side", "wrist")},
        "state": jnp.zeros((1, 7)),
    }
    return policy.sample(jax.random.key(0), obs, jnp.zeros(1, jnp.int32))


def refuse(capsys, *arguments):
    assert command.main([str(argument) for argument in arguments]) == 2
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    assert len(printed.out) == 0
    return " ".join(printed.err.split())


@pytest.mark.parametrize("name", mostly_slow(["whole-nf4", "half-nf4"], ["whole-nf4"]))
def test_table(run, capsys, name):
    """Outcomes 1101 and 1001 differ by one episode of four."""
    shutil.rmtree(run / "deployment", ignore_errors=True)
    arguments = [str(run), "--variants", name, "--episodes", "4"]
    assert command.main(arguments) == 0
    lines = capsys.readouterr().out.replace("\u00a0", " ").splitlines()
    assert len(lines) == 4
    assert lines[2].startswith("| whole-bf16 | 75.0 [")
    assert lines[3].startswith(f"| {name} | 50.0 [")
    assert "| −25.0 [" in lines[3]
    found = results.load(run / "deployment/results.json")
    assert found.keys() == {"whole-bf16", name}
    for cell in found.values():
        assert cell["config"]["evaluation"]["episodes"] == 4
        assert cell["measures"]["milliseconds"] == 1.5
        assert 0 < cell["measures"]["loss"] < 100
    assert found[name]["measures"]["bytes"] < found["whole-bf16"]["measures"]["bytes"]
    assert command.main(arguments) == 0  # nothing is measured again
    assert capsys.readouterr().out.replace("\u00a0", " ").splitlines() == lines
    other = refuse(capsys, run, "--variants", name, "--episodes", "8")
    assert "it was run with other evaluation.episodes" in other


@pytest.mark.slow
def test_a_call_takes_time(run):
    assert call_milliseconds(export.load_policy(run), EPISODES, STEPS) > 0


@pytest.mark.slow
def test_forms(run):
    policy = export.load_policy(run)
    forms = {form: variants.in_form(policy, form, EPISODES) for form in variants.FORMS}
    ranks = {
        form: {method.rank for method in adaptation.methods(forms[form].model).values()}
        for form in forms
    }
    assert (ranks["whole"], ranks["half"], ranks["merged"]) == ({RANK}, {RANK // 2}, set())
    assert ranks["lora"] == {RANK}
    assert max(ranks["pruned"]) <= RANK
    assert {leaf.dtype for leaf in jax.tree.leaves(forms["merged"].model)} == {
        jnp.dtype("bfloat16")
    }
    np.testing.assert_allclose(actions(forms["whole"]), actions(policy), atol=1e-2)
    np.testing.assert_allclose(actions(forms["lora"]), actions(forms["merged"]), atol=1e-2)
    assert not quantization.is_quantized(forms["whole"].model)
    sizes = {
        (form, base): measurement.weight_bytes(variants.on_base(forms[form], base))
        for form in forms
        for base in variants.BASES
    }
    ordered = [sizes[form, "bf16"] for form in ("merged", "lora", "whole")]
    assert ordered == sorted({*ordered})
    assert sizes["half", "bf16"] < sizes["whole", "bf16"]
    assert sizes["whole", "nf4"] < sizes["whole", "int8"] < sizes["whole", "bf16"]


@pytest.mark.parametrize(
    "name",
    mostly_slow(["half-nf4", "half-int8", "lora-int8", "merged-bf16", "merged-nf4"], ["half-nf4"]),
)
def test_a_saved_variant_is_served(run, tmp_path, capsys, name):
    out = tmp_path / "policy"
    assert command.main([str(run), "--save", name, "--out", str(out)]) == 0
    said = "64 windows of 3 episodes (21 frames) of simulated demonstrations of press"
    assert capsys.readouterr().out == f"written: {out}, calibrated on {said}\n"
    loaded = loading.load_run(str(out))
    assert loaded.metadata == SIMULATED
    assert loaded.denoise_steps == export.denoise_steps(run) == STEPS
    served = loaded.policy
    policy, kind = export.load_policy(run), name.split("-")[1]
    made = variants.transform(name, policy, EPISODES)
    assert quantization.is_quantized(served.model) == (kind != "bf16")
    assert measurement.weight_bytes(served) == measurement.weight_bytes(made)
    np.testing.assert_allclose(actions(served), actions(made), atol=1e-5)
    assert np.abs(actions(served) - actions(policy)).max() > 1e-4


def test_refusals(run, dummy_base, tmp_path, capsys):
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
    assert f"{tmp_path} is not a finished run" in unfinished
    lora = finished_run(tmp_path / "lora", dummy_base, LoRA(rank=2))
    error = refuse(capsys, lora, *save[1:], out)
    assert error.endswith("whole-bf16, whole-int8, whole-nf4, merged-bf16, merged-int8, merged-nf4")
    moe = finished_run(tmp_path / "moe", dummy_base, LoRAMoE(rank=2))
    error = refuse(capsys, moe, "--save", "merged-bf16", "--out", out)
    assert error.endswith(
        "unknown variant 'merged-bf16': choose one of whole-bf16, whole-int8, whole-nf4"
    )
    assert not out.exists()


@pytest.mark.parametrize("name", ["whole-nf4", "merged-bf16"])
def test_lora_is_saved_without_data(dummy_base, tmp_path, monkeypatch, name):
    monkeypatch.setattr(held_out, "demonstrations", None)
    lora, out = finished_run(tmp_path / "lora", dummy_base, LoRA(rank=2)), tmp_path / "policy"
    assert command.main([str(lora), "--save", name, "--out", str(out)]) == 0
    served, policy = loading.load_run(str(out)).policy, export.load_policy(lora)
    assert bool(adaptation.methods(served.model)) == (name == "whole-nf4")
    as_trained = variants.on_base(variants.in_form(policy, "whole", {}), name.split("-")[1])
    np.testing.assert_allclose(actions(served), actions(as_trained), atol=0.02)
    bare = dataclasses.replace(policy, model=models.load(dummy_base))
    assert np.abs(actions(served) - actions(bare)).max() > 0.1


def test_quantized_base_of_a_policy_is_checked(run, tmp_path):
    policy, kind = export.load_policy(run), cast(Any, "int2")
    export.write_variant(tmp_path / "x", policy, run, quantized=kind)
    with pytest.raises(ValueError, match="'int8' or 'nf4'"):
        export.load_policy(tmp_path / "x")
