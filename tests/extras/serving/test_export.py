"""Test the command that exports runs, and which policies can be exported."""

import dataclasses

import jax
import numpy as np
import pytest

import lorasp_jax
from lorasp_jax.adapters import adaptation
from lorasp_jax.extras.serving import export, exported, exporting
from lorasp_jax.models.inputs import InputConfig
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig
from lorasp_jax.training import load_policy
from lorasp_jax.training.fixed_batches import forward, keyed_batches
from lorasp_jax.training.run_folder import to_json, write_json
from tests.extras.serving.test_exported import arguments, in_process
from tests.extras.serving.test_policies import SIMULATED, make_policy
from tests.runs import CONFIG, random_episodes


def call(capsys, *words):
    code = export.main([str(word) for word in words])
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    return code, printed.out + printed.err


def assert_acts_like(policy, folder, atol=2e-5):
    loaded = exported.load(folder)
    given = arguments(loaded)
    np.testing.assert_allclose(loaded.act(**given), in_process(policy, given), atol=atol)


@pytest.fixture
def run(finished):
    return finished.folder


@pytest.fixture
def trained(run):
    """The run, as if it had been trained to continue chunks."""
    optim = dataclasses.replace(CONFIG.optim, rtc_max_delay=2)
    evaluation = dataclasses.replace(CONFIG.evaluation, denoise_steps=5)
    config = dataclasses.replace(CONFIG, optim=optim, evaluation=evaluation)
    write_json(run / "config.json", to_json(config))
    yield run
    (run / "config.json").unlink()


@pytest.mark.slow
def test_a_run_is_exported(trained, tmp_path, capsys):
    out = tmp_path / "new" / "policy"
    code, printed = call(capsys, trained, "--out", out, "--max-batch", 1, "--denoise-steps", 2)
    assert (code, printed.split(",")[0]) == (0, f"wrote {out}")
    programs = ["act-1.bin", "continue-1.bin"]
    data = ["instructions.json", "policy.json", "processor.json", "weights.safetensors"]
    assert sorted(path.name for path in out.iterdir()) == programs + data
    assert [path.name for path in out.parent.iterdir()] == ["policy"]
    assert_acts_like(load_policy(trained), out)


def test_the_command_exports_what_the_run_says(run, trained, tmp_path, capsys, monkeypatch):
    given = {}

    def write(policy, folder, **options):
        folder.mkdir()
        given.update(options, instructions=policy.processor.prompts.instructions)

    monkeypatch.setattr(exporting, "write", write)
    assert call(capsys, run, "--out", tmp_path / "policy", "--max-batch", 3)[0] == 0
    assert given.pop("instructions")[0] == "press the button"
    assert given == {"continues": True, "num_steps": 5, "max_batch": 3, "metadata": SIMULATED}
    assert call(capsys, run, "--out", tmp_path / "quick", "--denoise-steps", 2)[0] == 0
    assert given["num_steps"] == 2


def test_refusals(run, tmp_path, capsys):
    (tmp_path / "policy").mkdir()
    (tmp_path / "unfinished").mkdir()
    for words, refusal in (
        ((run, "--out", tmp_path / "policy"), "already exists"),
        ((tmp_path / "unfinished", "--out", tmp_path / "new"), "no run has finished there"),
        ((tmp_path / "nowhere", "--out", tmp_path / "new"), f"is no folder {tmp_path / 'nowhere'}"),
        ((run, "--out", tmp_path / "new", "--max-batch", 0), "largest batch"),
    ):
        code, printed = call(capsys, *words)
        assert (code, refusal in printed.replace("\n", " ")) == (2, True), printed
    assert sorted(path.name for path in tmp_path.iterdir()) == ["policy", "unfinished"]
    assert not list((tmp_path / "policy").iterdir())


def test_policies_that_cannot_be_exported(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    before, policy, out = jax.config.values.copy(), make_policy(), tmp_path / "policy"
    processor = policy.processor
    prompts = dataclasses.replace(processor.prompts, instructions=())
    silent = dataclasses.replace(processor, prompts=prompts)
    with pytest.raises(ValueError, match="without instructions"):
        exporting.write(dataclasses.replace(policy, processor=silent), out)
    with pytest.raises(ValueError, match="already exists"):
        exporting.write(policy, tmp_path)
    monkeypatch.setattr(exporting, "_trace", fail)
    with pytest.raises(OSError, match="No space left"):
        exporting.write(policy, out)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with pytest.raises(ValueError, match="JAX_PLATFORMS=cpu"):
        exporting.write(policy, out)
    assert not list(tmp_path.iterdir())
    assert jax.config.values == before


def dummy(config=Pi0Config, **changes):
    return make_policy(dataclasses.replace(config.dummy(), **changes))


def quantized(policy, kind):
    model, _ = lorasp_jax.quantize(policy.model, [(".*", kind)])
    return dataclasses.replace(policy, model=model)


def pruned(policy):
    episodes = {"press": random_episodes("press", 5)}
    (batches,) = keyed_batches(policy, episodes, 4, 1).values()
    model, _ = lorasp_jax.prune(policy.model, batches, 0.5, forward=forward)
    return dataclasses.replace(policy, model=model)


def merged(policy):
    """Return the policy distilled to adapters that do not depend on the input, and merged."""
    episodes = {"press": random_episodes("press", 5)}
    pairs = keyed_batches(policy, episodes, 4, 1)["press"]
    model, _ = lorasp_jax.distill(policy.model, pairs, 4, forward=forward)
    return dataclasses.replace(policy, model=adaptation.merge(model))


POLICIES = {
    "smolvla": lambda _: dummy(SmolVLAConfig),
    "state in the prompt": lambda _: dummy(inputs=InputConfig(prompt_state=True), max_tokens=64),
    "bfloat16": lambda _: dummy(param_dtype="bfloat16"),
    "int8": lambda _: quantized(dummy(), "int8"),
    "adapters, nf4": lambda run: quantized(load_policy(run), "nf4"),
    "pruned, nf4": lambda run: quantized(pruned(load_policy(run)), "nf4"),
    "merged": lambda run: merged(load_policy(run)),
    "merged, int8": lambda run: quantized(merged(load_policy(run)), "int8"),
}


@pytest.mark.slow  # test_exported.py has a plain policy
@pytest.mark.parametrize("name", POLICIES)
def test_all_kinds_of_policies_are_exported(name, run, tmp_path):
    policy = POLICIES[name](run)
    exporting.write(policy, tmp_path / "policy", num_steps=2, max_batch=1)
    # In bf16, programs that were compiled differently also round differently.
    atol = 5e-3 if name == "bfloat16" else 2e-5
    assert_acts_like(policy, tmp_path / "policy", atol)
