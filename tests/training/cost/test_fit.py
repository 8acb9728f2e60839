"""`--fit` chooses the cheapest settings that fit, and its estimate is near what XLA plans."""

import dataclasses
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from benchmarks.backbones import Step
from lorasp_jax.config import Config, DataConfig, ModelConfig, OptimConfig
from lorasp_jax.models.config import ExpertConfig
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import FullFineTuning, LoRA
from lorasp_jax.training.cost import fit, preflight
from lorasp_jax.training.cost.dry_run import planned_bytes
from lorasp_jax.training.run_folder import to_json, write_json

TINY = dataclasses.replace(Pi0Config.dummy(), vision=Pi0Config.nano().vision, image_size=64)
CONFIG = Config(
    name="a",
    scale="cpu",
    peft=LoRA(rank=4),
    targets=("openpi",),
    data=DataConfig(source="recordings"),
    optim=OptimConfig(batch_size=64),
)
MIB_GB, NOWHERE = preflight.MIB / 1e9, Path("nowhere")


@pytest.fixture
def sizes(monkeypatch):
    """A GPU without a context, a device, and peaks that settings lower to known values [MiB]."""
    monkeypatch.setattr(fit, "CONTEXT", 0)
    monkeypatch.setattr(fit, "FILLED", 1)
    monkeypatch.setattr(fit.jax, "device_count", lambda: 1)
    monkeypatch.setattr(fit, "base_model", lambda *_, **__: (SimpleNamespace(config=TINY), ""))
    stored = {"": 400, "int8": 100, "nf4": 50}

    def peak(config, backbone):
        del backbone
        model, windows = config.model, config.optim.batch_size / config.optim.accumulate
        base = stored[model.base_dtype] / (1 + (model.param_dtype == "bfloat16"))
        each = {"none": 4, "products": 2, "narrow": 1, "full": 0.5}[model.remat]
        return preflight.MIB * (base + each * windows)

    monkeypatch.setattr(fit, "expected_peak", peak)
    monkeypatch.setattr(fit, "plan_step", lambda *_: (None, 0, lambda: None))


def chosen(mib, config=CONFIG, given=()):
    """Return remat, accumulation and dtypes that fit into so many MiB."""
    found = fit.fitted(config, f"{mib * MIB_GB:.4f}GB", given, NOWHERE, Console(quiet=True))
    assert dataclasses.replace(found, model=config.model, optim=config.optim) == config
    assert found.optim.batch_size == config.optim.batch_size
    model = found.model
    return model.remat, found.optim.accumulate, model.param_dtype, model.base_dtype


@pytest.mark.parametrize(
    ("mib", "expected"),
    [
        (657, ("none", 1, "float32", "")),
        (655, ("none", 1, "bfloat16", "")),  # costs nothing
        (454, ("none", 2, "bfloat16", "")),  # half of the windows at a time, before recomputing
        (230, ("products", 8, "bfloat16", "")),  # costs less than ("none", 16)
        (210, ("narrow", 8, "bfloat16", "")),
        (200, ("none", 2, "bfloat16", "int8")),  # rounding comes after what changes no result
        (40, ("narrow", 8, "bfloat16", "nf4")),
        (25.7, ("full", 64, "bfloat16", "nf4")),
    ],
)
def test_the_cheapest_settings_that_fit_are_chosen(sizes, mib, expected):
    assert chosen(mib) == expected


def test_candidates_are_sorted_by_cost(sizes):
    costs = [fit.cost(candidate) for candidate, _ in fit.ranked(CONFIG)]
    assert costs == sorted(costs)
    assert len(costs) == len(preflight.REMATS) * 7 * 4


def test_given_settings_are_kept(sizes):
    small = dataclasses.replace(CONFIG, model=ModelConfig(remat="full", base_dtype="int8"))
    assert chosen(200, small) == ("full", 1, "bfloat16", "int8")
    names = {"optim.accumulate", "model.base_dtype", "model.param_dtype", "model.remat"}
    with pytest.raises(ValueError, match="given settings need at least"):
        chosen(420, given=names - {"model.remat"})
    assert chosen(900, given=names) == ("none", 1, "float32", "")


def test_a_part_of_the_memory_stays_free(sizes, monkeypatch):
    monkeypatch.setattr(fit, "FILLED", 0.9)
    assert chosen(400 + 4 * 64) == ("none", 1, "bfloat16", "")
    assert chosen((400 + 4 * 64) / 0.9 + 1) == ("none", 1, "float32", "")


@pytest.mark.parametrize("filled", [1, 0.9])
def test_the_least_memory_in_the_message_fits(sizes, filled, monkeypatch):
    monkeypatch.setattr(fit, "FILLED", filled)
    with pytest.raises(ValueError, match=r"does not fit into 0\.0100GB") as caught:
        chosen(0.01 / MIB_GB)
    (least,) = re.findall(r"--fit ([\d.]+GB)", str(caught.value))
    fit.fitted(CONFIG, least, (), NOWHERE, Console(quiet=True))
    assert "\n" not in str(caught.value)


def test_full_fine_tuning_keeps_its_base(sizes):
    full = dataclasses.replace(CONFIG, peft=FullFineTuning())
    assert {candidate.model.base_dtype for candidate, _ in fit.ranked(full)} == {""}


def test_on_a_gpu_the_plan_of_the_compiler_decides(sizes, monkeypatch):
    monkeypatch.setattr(fit.jax, "default_backend", lambda: "gpu")
    plans = iter([700, 300])
    monkeypatch.setattr(fit, "planned_bytes", lambda _: {"all": next(plans) * preflight.MIB})
    assert chosen(657) == ("none", 1, "bfloat16", "")


def test_data_on_the_device_counts(sizes, monkeypatch, capsys):
    """What can be streamed is not there, as the sentence says; demonstrations are."""
    held = 1024 * preflight.MIB
    monkeypatch.setattr(fit, "plan_step", lambda *_: (None, held, lambda: None))
    assert chosen(1024 + 657) == ("none", 1, "float32", "")
    assert chosen(1024 + 655) == ("none", 1, "bfloat16", "")
    simulated = dataclasses.replace(CONFIG, data=DataConfig())
    with pytest.raises(ValueError, match=r"need at least --fit 1\.\d+GB;"):
        chosen(1024, simulated)
    with pytest.raises(ValueError, match="room for its demonstrations"):
        chosen(10, simulated)
    fit.fitted(CONFIG, "2GB", (), NOWHERE, Console(width=300))
    assert "1.0 GiB of data" in capsys.readouterr().out
    monkeypatch.setattr(fit, "plan_step", lambda *_: (None, 0, lambda: None))
    fit.fitted(CONFIG, "2GB", (), NOWHERE, Console(width=300))
    assert "streamed from disk" in capsys.readouterr().out


def test_a_resumed_run_keeps_what_was_chosen(sizes, tmp_path):
    assert fit.resumed(CONFIG, (), tmp_path) is None
    started = fit.fitted(CONFIG, f"{200 * MIB_GB:.4f}GB", (), tmp_path, Console(quiet=True))
    write_json(tmp_path / "config.json", to_json(started))
    assert fit.resumed(CONFIG, (), tmp_path) == started
    unquantized = fit.fitted(CONFIG, "1GB", (), tmp_path, Console(quiet=True))
    write_json(tmp_path / "config.json", to_json(unquantized))
    assert fit.resumed(started, (), tmp_path) == unquantized
    given = dataclasses.replace(CONFIG, optim=dataclasses.replace(CONFIG.optim, accumulate=4))
    kept = fit.resumed(given, {"optim.accumulate"}, tmp_path)
    assert kept == dataclasses.replace(unquantized, optim=given.optim)


@pytest.mark.parametrize(("text", "size"), [("16GB", 16e9), ("14.5 GiB", 14.5 * 2**30)])
def test_sizes(text, size):
    assert fit.read_size(text) == size


@pytest.mark.parametrize("text", ["16", "16gb", "GB", "0GB", "-1GB", "1e3GB", "16 GB "])
def test_a_size_needs_a_number_and_a_unit(text):
    with pytest.raises(ValueError, match="16GB"):
        fit.read_size(text)


@pytest.mark.parametrize(
    ("base_dtype", "remat", "parts"),
    [("nf4", "full", 4), pytest.param("", "products", 1, marks=pytest.mark.slow)],
)
def test_the_estimate_is_near_the_compiled_memory(base_dtype, remat, parts, monkeypatch):
    """Where layers and not images need the memory, as at published sizes."""
    monkeypatch.setattr(preflight.jax, "device_count", lambda: 1)
    optim = dataclasses.replace(CONFIG.optim, accumulate=parts)
    model = ModelConfig(checkpoint="", base_dtype=base_dtype, remat=remat)
    config = dataclasses.replace(CONFIG, optim=optim, model=model)
    shared = {"depth": 4, "heads": 4, "kv_heads": 1, "head_dim": 16}
    language, action = ExpertConfig(64, mlp=512, **shared), ExpertConfig(32, mlp=64, **shared)
    towers = {"language": language, "action": action}
    backbone = dataclasses.replace(Pi0Config.dummy(), **towers, max_tokens=48, remat=remat)
    planned = sum(planned_bytes(Step(backbone, config).compiled).values())
    assert 0.85 < preflight.estimate_memory(config, backbone).peak / planned < 1.3
