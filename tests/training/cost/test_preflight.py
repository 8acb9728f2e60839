"""Estimated memory of a step: exact for parameters, and a one-line error if it cannot fit."""

import dataclasses
import functools

import pytest

from lorasp_jax.config import Config, ModelConfig, OptimConfig
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import FullFineTuning, LoRA
from lorasp_jax.training.cost import preflight

CONFIG = Config(
    name="a",
    scale="cpu",
    peft=LoRA(rank=4),
    targets=("patch_embed", "q_proj", "down_proj"),
    optim=OptimConfig(batch_size=64),
)
TINY = dataclasses.replace(Pi0Config.dummy(), vision=Pi0Config.nano().vision, image_size=64)


@pytest.fixture(scope="module", autouse=True)
def cached_models():
    """Trace each adapted model only once for all tests."""
    build = preflight.abstract_model

    @functools.cache
    def model(method, targets, backbone):
        return build(dataclasses.replace(CONFIG, peft=method, targets=targets), backbone)

    with pytest.MonkeyPatch.context() as patch:
        cached = lambda config, backbone: model(config.peft, config.targets, backbone)  # noqa: E731
        patch.setattr(preflight, "abstract_model", cached)
        yield


@pytest.fixture(scope="module")
def memory(cached_models):
    return {
        remat: preflight.estimate_memory(CONFIG, dataclasses.replace(TINY, remat=remat))
        for remat in preflight.REMATS
    }


def test_parameter_memory_is_exact(memory, monkeypatch):
    monkeypatch.setattr(preflight, "_saved_bytes", lambda *_, **__: 0)  # only parameters count
    found = memory["none"]
    assert found.gradients == found.adapters
    assert 2 * found.adapters < found.optimizer < 2 * found.adapters + 100  # moments, counters
    every = dataclasses.replace(CONFIG, peft=FullFineTuning(), targets=(".*",))
    full = preflight.estimate_memory(every, TINY)
    half = preflight.estimate_memory(CONFIG, dataclasses.replace(TINY, param_dtype="bfloat16"))
    assert full.base == 0
    assert full.adapters == found.base == 2 * half.base


def test_activations_grow_with_the_batch_and_shrink_with_remat(memory):
    none, products, narrow, full = (memory[remat].activations for remat in preflight.REMATS)
    assert none > 1.5 * products > 2 * full > 0
    assert products > narrow > full
    optim = dataclasses.replace(CONFIG.optim, batch_size=128)
    twice = preflight.estimate_memory(dataclasses.replace(CONFIG, optim=optim), TINY)
    assert twice.activations == pytest.approx(2 * none, rel=0.1)


def test_only_rematerialization_recomputes(memory):
    none, products, narrow, full = (memory[remat].recomputation for remat in preflight.REMATS)
    assert none == 0
    assert 0 < products == narrow == full < memory["none"].activations


def test_gradient_accumulation_and_ema(memory):
    none = memory["none"]
    optim = dataclasses.replace(CONFIG.optim, accumulate=4, ema=0.5)
    found = preflight.estimate_memory(dataclasses.replace(CONFIG, optim=optim), TINY)
    assert found.gradients == 2 * none.gradients  # of a micro-batch, and the sum
    assert found.optimizer == none.optimizer + none.adapters
    assert found.activations < 0.5 * none.activations


def test_the_least_rematerialization_that_fits_is_chosen(memory, monkeypatch):
    monkeypatch.setattr(preflight, "estimate_memory", lambda _, backbone: memory[backbone.remat])
    for remat in preflight.REMATS:
        assert preflight.choose_remat(CONFIG, TINY, memory[remat].peak)[0] == remat
    full = dataclasses.replace(CONFIG, model=ModelConfig(remat="full"))
    assert preflight.choose_remat(full, TINY, memory["none"].peak)[0] == "full"


def test_a_run_that_cannot_fit_is_refused(memory, monkeypatch):
    monkeypatch.setattr(preflight, "estimate_memory", lambda _, backbone: memory[backbone.remat])
    available = (memory["full"].peak + preflight.HEADROOM * memory["full"].base) / 2
    with pytest.raises(ValueError, match=r"needs about .* GiB .*--optim.batch-size") as caught:
        preflight.choose_remat(CONFIG, TINY, available)
    assert "\n" not in str(caught.value)


def test_a_device_has_memory():
    assert 2**28 < preflight.available_bytes() < 2**50
