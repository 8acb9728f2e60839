"""Runs built from a config, including adapters initialized from the demonstrations."""

import contextlib
import dataclasses
import gc
import io
import json
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from rich.console import Console

from lorasp_jax import models
from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.compress import quantization
from lorasp_jax.config import DataConfig, ModelConfig
from lorasp_jax.data.batches import nbytes
from lorasp_jax.data.opening import open_source
from lorasp_jax.models import inputs
from lorasp_jax.models.checkpoints import loading
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import FullFineTuning, LoRA
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.tokenizer import Offline
from lorasp_jax.training import activations, base, export, rules, setup
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.loop import train
from lorasp_jax.training.overrides import override
from lorasp_jax.training.run import Run
from tests import GOLDEN, ROOT
from tests.data.lerobots import golden
from tests.models.random_models import observation, random_backbone
from tests.runs import CONFIG, leaves, random_episodes

TARGETS = ("patch_embed", "language.*q_proj", "action_out_proj")


def environment(*instructions):
    return SimpleNamespace(instructions=instructions, robot=SimpleNamespace(num_joints=6))


def collect(config, *_):
    return {task: random_episodes(task, 0) for task in config.tasks}


def prepare(config, folder, collect=collect, file=None):
    """Prepare a run on random episodes."""
    console = Console(file=file or io.StringIO(), width=200)
    start = time.perf_counter()
    return setup.prepare(config, folder, console, start, collect=collect)


@pytest.fixture
def config(monkeypatch):
    """A config without simulation, on the dummy backbone."""
    base = random_backbone(Pi0Config.dummy()), ""
    monkeypatch.setattr(setup, "base_model", lambda *_, **__: base)
    env = environment(*random_episodes("", 0).instructions)
    monkeypatch.setattr(setup.envs, "make", lambda *_, **__: env)
    remat = "none", preflight.Memory(*6 * [0.0])
    monkeypatch.setattr(preflight, "choose_remat", lambda *_: remat)
    config = dataclasses.replace(CONFIG, peft=LoRA(rank=4), targets=TARGETS)
    config = dataclasses.replace(
        config, evaluation=dataclasses.replace(config.evaluation, execute_steps=1)
    )
    return override(config, ["--peft.initialization", "eva"])


def test_targets_on_the_command_line_can_be_presets(config, tmp_path):
    kaiming = override(
        config, ["--targets", "language", "^vision/head", "--peft.initialization", "kaiming"]
    )
    printed = io.StringIO()
    run = prepare(kaiming, tmp_path, file=printed)
    found = adaptation.methods(run.policy.model)
    assert {path.rpartition("/")[0] for path in found} == {"language/blocks", "vision"}
    assert "; entirely frozen: action, action_in_proj," in printed.getvalue()


def test_an_incompatible_tokenizer_is_rejected_before_collection(config, tmp_path):
    """So are cached demonstrations with different instructions."""
    console = Console(file=io.StringIO())
    smolvlm = GOLDEN / "tokenizers/smolvlm_like_tokenizer.json"
    other = override(config, ["--model.tokenizer", str(smolvlm)])
    with pytest.raises(ValueError, match="demonstrations with different instructions"):
        setup._collect(Run(config, tmp_path, console, "", 0), ["press the red button"], collect)
    fail = lambda *_: pytest.fail("it collects")  # noqa: E731
    with pytest.raises(ValueError, match="vocabulary 320"):
        prepare(other, tmp_path, collect=fail)


def test_a_bundled_base_learns_another_control_period_from_recordings():
    config = dataclasses.replace(CONFIG, model=ModelConfig(), control_dt=0.05)
    with pytest.raises(ValueError, match=r"with control_dt 0\.1 s, but this run has 0\.05 s"):
        base.base_model(config)
    recorded = dataclasses.replace(config, data=DataConfig(source="recorded"))
    _, digest = base.base_model(recorded)
    assert digest == models.weights_hash(ROOT / "assets" / "pi0_nano")


def test_a_base_to_be_quantized_stays_on_the_host(monkeypatch):
    """A small GPU never holds more of it unquantized than one kernel."""
    model = ModelConfig(checkpoint="assets/pi0_nano", base_dtype="nf4")
    config = dataclasses.replace(CONFIG, model=model, targets=("q_proj",))
    with jax.default_device(jax.devices()[1]):
        found, digest = base.base_model(config)
        assert digest == models.weights_hash(ROOT / "assets" / "pi0_nano")
        assert {type(x) for x in jax.tree.leaves(nnx.state(found))} == {np.ndarray}
        adapted = setup._adapt(config, found, rules.rules(config))
    _, adapters, frozen = adaptation.split(adapted)
    assert {type(x) for x in jax.tree.leaves(adapters)} == {np.ndarray}
    assert {x.devices().pop() for x in jax.tree.leaves(frozen)} == {jax.devices()[1]}
    monkeypatch.setattr(jax, "local_devices", lambda **_: jax.devices("unknown"))
    with pytest.raises(ValueError, match=r"set JAX_PLATFORMS=.*,cpu"):
        base.base_model(config)


@contextlib.contextmanager
def quantizing(monkeypatch, device):
    """Yield a list of the bytes on the device, beyond those now, at each kernel and at the end."""

    def held():
        gc.collect()
        return sum(x.nbytes for x in jax.live_arrays() if device in x.devices())

    before, found, quantize = held(), [], quantization.quantize_kernel
    gc.freeze()  # what is there already need not be searched at each kernel
    recorded = lambda *arguments: (found.append(held() - before), quantize(*arguments))[1]  # noqa: E731
    monkeypatch.setattr(quantization, "quantize_kernel", recorded)
    with jax.default_device(device):
        yield found
    found.append(held() - before)


@pytest.mark.parametrize("initialization", ["pissa", "olora"])
def test_residuals_of_a_base_to_be_quantized_stay_on_the_host(initialization, monkeypatch):
    """They are those of a base on the device, which never holds two kernels unquantized."""
    original = random_backbone(Pi0Config.dummy())
    model = ModelConfig(base_dtype="nf4")
    config = dataclasses.replace(CONFIG, model=model, targets=("language/.*(q|gate|up)_proj",))
    config = dataclasses.replace(config, peft=LoRA(rank=4, initialization=initialization))
    pairs = rules.rules(config)
    found = base.on_host(lambda: original)
    with quantizing(monkeypatch, jax.devices()[1]) as held:
        adapted = setup._adapt(config, found, pairs)
    sizes = [x.nbytes for x in jax.tree.leaves(nnx.state(found))]
    adapters = nbytes(adaptation.split(adapted)[1])
    assert max(held[:-1]) <= 1.1 * (adapters + max(sizes)) < 0.5 * sum(sizes)
    on_host, on_device = (
        adaptation.adapt(each, pairs, rngs=nnx.Rngs(0)) for each in (found, original)
    )
    assert {type(x) for x in jax.tree.leaves(adaptation.split(on_host)[2])} == {np.ndarray}
    expected = leaves(nnx.state(on_device, nnx.Param))
    for name, value in leaves(nnx.state(on_host, nnx.Param)).items():
        np.testing.assert_allclose(value, expected[name], atol=1e-5, err_msg=name)


def test_a_policy_on_a_quantized_base_is_loaded_without_the_original(config, tmp_path, monkeypatch):
    """Its device never holds more of the base unquantized than one kernel, and then nothing."""
    folder = tmp_path / "base"
    models.save(folder, random_backbone(Pi0Config.dummy()))
    config = dataclasses.replace(
        config,
        peft=LoRA(rank=4),
        model=ModelConfig(checkpoint=str(folder), base_dtype="nf4"),
    )
    (tmp_path / "run").mkdir()
    unquantized = models.load(folder)
    monkeypatch.setattr(setup, "base_model", lambda *_, **__: (unquantized, ""))
    run = prepare(config, tmp_path / "run")
    export.write(run)
    device, size = jax.devices()[1], nbytes(nnx.state(run.policy.model))
    with quantizing(monkeypatch, device) as held:
        loaded = export.load_policy(run.folder)
    state = jax.tree.leaves(nnx.state(loaded.model))
    assert {x.devices().pop() for x in state} == {device}
    assert nbytes(state) == size < nbytes(nnx.state(unquantized))
    largest = max(x.nbytes for x in jax.tree.leaves(nnx.state(unquantized)))
    adapters = nbytes(adaptation.split(loaded.model)[1])
    assert max(held[:-1]) <= 1.1 * (2 * adapters + largest) < 0.5 * nbytes(nnx.state(unquantized))
    assert held[-1] <= size + nbytes(loaded.processor)


def test_lerobot_policies_are_preprocessed_as_their_config_says(config, tmp_path, monkeypatch):
    fields = {
        "type": "pi0",
        "normalization_mapping": {"STATE": "QUANTILE10", "ACTION": "MIN_MAX"},
        "use_relative_actions": True,
        "action_feature_names": ["a", "b", "gripper"],
        "output_features": {"action": {"shape": [3]}},
    }
    (tmp_path / "config.json").write_text(json.dumps(fields))
    weightless = lambda _, model_config: SimpleNamespace(config=model_config)  # noqa: E731
    monkeypatch.setattr(loading.ModelFolder, "load", weightless)
    monkeypatch.setattr(models, "weights_hash", lambda _: "")
    model = ModelConfig(size="base", checkpoint=str(tmp_path))
    expected = dataclasses.replace(
        inputs.LEROBOT_PI0, state="quantile10", action="min_max", delta=(True, True, False)
    )
    found, _ = base.base_model(dataclasses.replace(config, model=model))
    assert found.config.inputs == expected
    (tmp_path / "config.json").unlink()
    found, _ = base.base_model(dataclasses.replace(config, model=model))
    assert found.config.inputs == inputs.OPENPI
    two_arms = dataclasses.replace(inputs.OURS, delta=(True,) * 14)
    found = random_backbone(dataclasses.replace(Pi0Config.dummy(), inputs=two_arms))
    monkeypatch.setattr(setup, "base_model", lambda *_, **__: (found, ""))
    run = prepare(config, tmp_path)  # another robot has a mask of its own
    assert run.policy.processor.inputs.delta == (*[True] * 6, False)


def test_the_chunk_length_on_the_command_line(config, tmp_path):
    """It limits how many actions can be given in training."""
    longer = override(config, ["--model.chunk", "6", "--optim.rtc-max-delay", "5"])
    longer = override(longer, ["--peft.initialization", "kaiming"])
    run = prepare(longer, tmp_path)
    model, obs = run.policy.model, observation(run.policy.model.config, 2)
    chunk = jax.eval_shape(lambda: model.sample_actions(jax.random.key(0), obs))
    assert chunk.shape == (2, 6, 8)
    with pytest.raises(ValueError, match="rtc_max_delay must be below the chunk length 4, got 5"):
        prepare(override(longer, ["--model.chunk", "0"]), tmp_path)


def test_pi05_on_the_command_line():
    config = override(CONFIG, ["--model.size", "nano_pi05"])
    model, _ = base.base_model(config, abstract=True)
    assert (model.config.pi05, model.config.inputs) == (True, inputs.OURS_PI05)


@pytest.mark.slow
def test_pi05_on_the_command_line_trains_and_acts(config, tmp_path, monkeypatch):
    """Its fully fine-tuned base loads again, and its prompts depend on the state."""
    monkeypatch.setattr(setup, "base_model", base.base_model)
    config = dataclasses.replace(config, peft=FullFineTuning(), model=ModelConfig(checkpoint=""))
    run = prepare(override(config, ["--model.size", "nano_pi05", "--optim.steps", "2"]), tmp_path)
    run.devices = jax.devices()[:1]
    before = leaves(nnx.state(run.policy.model))
    train(run)
    after = leaves(nnx.state(run.policy.model))
    assert any((after[name] != array).any() for name, array in before.items())
    group = next(iter(run.episodes.values()))
    raw = {
        "image": {name: jnp.asarray(image[:, 0]) for name, image in group.image.items()},
        "state": jnp.asarray(group.state[:, 0]),
    }
    tokens = run.policy.processor.encode(raw, jnp.zeros(3, int)).tokens
    assert (tokens[0] != tokens[1]).any()
    sample = jax.jit(Policy.sample)
    actions = sample(run.policy, jax.random.key(0), raw, jnp.zeros(3, int))
    assert jnp.isfinite(actions).all()
    export.write(run)
    model = models.load(tmp_path / "base")
    assert (model.config.pi05, model.config.inputs) == (True, inputs.OURS_PI05)
    again = sample(Policy(model, run.policy.processor), jax.random.key(0), raw, jnp.zeros(3, int))
    np.testing.assert_allclose(again, actions, atol=0.05)  # the file is bf16


def test_unrolling_on_the_command_line(monkeypatch):
    monkeypatch.setattr(base, "SIZES", ("dummy",))
    monkeypatch.setattr(Pi0Config, "create", lambda config, _: config)
    monkeypatch.setattr(base.models, "weights_hash", lambda _: "")
    unroll = lambda *options: base.base_model(override(CONFIG, [*options]))[0].unroll  # noqa: E731
    assert not unroll()
    assert unroll("--model.unroll", "True")


def test_a_quantized_base_on_the_command_line_trains_and_acts(config, tmp_path, monkeypatch):
    """Only adapters change; the estimate of memory counts its bytes; the policy loads again."""
    models.save(tmp_path / "base", random_backbone(Pi0Config.dummy()))
    config = dataclasses.replace(config, peft=LoRA(rank=4), model=ModelConfig())
    options = ["--model.base-dtype", "float8", "--optim.steps", "2"]
    config = override(config, [*options, "--model.checkpoint", str(tmp_path / "base")])
    base_model = models.load(tmp_path / "base"), models.weights_hash(tmp_path / "base")
    (tmp_path / "run").mkdir()
    monkeypatch.setattr(setup, "base_model", lambda *_, **__: base_model)
    run = prepare(config, tmp_path / "run")
    run.devices = jax.devices()[:1]
    _, adapters, frozen = adaptation.split(run.policy.model)
    codes = [leaf for leaf in jax.tree.leaves(frozen) if leaf.dtype == jnp.float8_e4m3fn]
    assert sum(code.size for code in codes) > 0.5 * nbytes(frozen)  # the rest: fp32
    abstract = preflight.abstract_model(config, run.policy.model.config)
    assert nbytes(adaptation.split(abstract)[2]) == nbytes(frozen)
    before = leaves(adapters)
    train(run)
    _, trained, after = map(leaves, adaptation.split(run.policy.model))
    assert all((value == after[name]).all() for name, value in leaves(frozen).items())
    assert all((value != trained[name]).any() for name, value in before.items())
    export.write(run)
    loaded = leaves(nnx.state(export.load_policy(run.folder).model, nnx.Param))
    expected = leaves(nnx.state(run.policy.model, nnx.Param))
    assert loaded.keys() == expected.keys()
    for name, value in loaded.items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)
    with pytest.raises(ValueError, match=r"model\.base_dtype must be empty for full"):
        rules.named_rules(dataclasses.replace(config, peft=FullFineTuning()))


def test_eva_uses_the_demonstrations(config, tmp_path, monkeypatch):
    measured, measure = [], setup.input_moments
    record = lambda *arguments: measured.append(measure(*arguments)) or measured[0]  # noqa: E731
    monkeypatch.setattr(setup, "input_moments", record)
    run = prepare(config, tmp_path)
    found = adaptation.methods(run.policy.model)
    assert {method.initialization for method in found.values()} == {"eva"}
    (moments,) = measured
    assert set(moments) == set(found)
    assert len(found) == 3
    model = nnx.List([run.policy.model])
    for path, _, _, variable in paths.locate(model, adaptation.AdapterParam):
        a = np.float64(variable.get_value()["lora_a"])
        moment = np.float64(moments[path.rpartition("/")[0]])
        captured = np.einsum("...ir,...ij,...jr->...", a, moment, a)
        best = np.linalg.eigvalsh(moment)[..., -4:].sum(-1)
        np.testing.assert_allclose(captured, best, rtol=1e-3)  # no other 4 directions capture more


def test_eva_measures_only_the_layers_of_its_rules(config, tmp_path, monkeypatch):
    measured, measure = [], setup.input_moments
    record = lambda *arguments: measured.append(measure(*arguments)) or measured[0]  # noqa: E731
    monkeypatch.setattr(setup, "input_moments", record)
    config = dataclasses.replace(config, adapt=("q_proj=lora:2", "language=lora_sp:2"))
    run = prepare(config, tmp_path)
    found = adaptation.methods(run.policy.model)
    assert found["language/blocks/q_proj"] == dataclasses.replace(config.peft, rank=2)
    assert set(measured[0]) == {path for path in found if path.endswith("q_proj")}


def test_eva_uses_a_streamed_dataset(config, tmp_path):
    run = prepare(override(config, ["--peft.initialization", "kaiming"]), tmp_path)
    table = run.policy.processor
    on_device = activations.batch_sampler(run, table, 4)(jax.random.key(0))
    run.dataset, run.streams = jax.tree.map(np.asarray, run.steps), True
    sample = activations.batch_sampler(run, table, 4)
    first, second = sample(jax.random.key(0)), sample(jax.random.key(0))
    assert jax.tree.map(np.shape, first) == jax.tree.map(np.shape, on_device)
    assert (first.actions != second.actions).any()


@pytest.mark.parametrize("relative", [False, True])
def test_normalized_actions_have_mean_0_and_standard_deviation_1(relative):
    """Over all training windows."""
    group, model = random_episodes("press", 0), Pi0Config.dummy()
    prompts = PromptTable.of(Offline(), group.instructions, model, num_joints=6)
    mask = relative * (*[True] * 6, False)
    model = dataclasses.replace(model, inputs=dataclasses.replace(model.inputs, delta=mask))
    found = setup.processor([group], model, prompts)
    states, chunks = [], []
    for episode in range(3):
        end = group.length[episode] - 1
        for step in range(end + 1):
            states.append(group.state[episode, step])
            chunks.append(group.action[episode, np.minimum(step + np.arange(model.chunk), end)])
    state, chunk = np.stack(states), np.stack(chunks)
    learned = found.normalize_actions(chunk, state)[..., found.flow_slots]
    normalized = learned if relative else learned[:, :1]
    np.testing.assert_allclose(normalized.mean(axis=(0, 1)), 0, atol=1e-5)
    np.testing.assert_allclose(normalized.std(axis=(0, 1)), 1, atol=1e-4)
    np.testing.assert_allclose(
        found.decode(found.normalize_actions(chunk, state), state), chunk, atol=1e-5
    )
    if relative:  # the first action of a chunk, less its state; the gripper stays absolute
        moved = chunk - np.append(np.ones(6), 0) * state[:, None]
        expected = (moved - moved.mean(axis=(0, 1))) / moved.std(axis=(0, 1))
        np.testing.assert_allclose(learned, expected, atol=1e-4)


def test_instructions_of_a_dataset_that_are_too_long_are_rejected():
    tokenizer, model = Offline(), dataclasses.replace(Pi0Config.nano(), max_tokens=10)
    source = open_source(golden("v3"))
    fits = dataclasses.replace(model, max_tokens=11)
    prompts, joints = setup._prompts_and_joints(source, [], tokenizer, fits)
    assert prompts.instructions == source.episode(0, ()).instructions
    assert joints == source.episode(0, ()).state.shape[-1] - 1
    with pytest.raises(ValueError, match=r"--model\.max-tokens: 'pick up .*' must have 1 to 10 "):
        setup._prompts_and_joints(source, [], tokenizer, model)
