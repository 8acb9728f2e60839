"""Samplers with a float8 base: what stays in float8, and that the actions stay the same."""

import contextlib
import dataclasses
import functools
from typing import Any, cast

import jax
import numpy as np
import pytest
from flax import nnx

from lorasp_jax.adapters.compress.quantization import quantize
from lorasp_jax.kernels import frozen_matmul
from lorasp_jax.kernels.quantized_weights import Kind, QuantizedKernel
from lorasp_jax.models import pi0
from lorasp_jax.models.sampling import Sampler
from tests.jaxprs import target
from tests.models.random_models import observation, random_backbone
from tests.nets import METHODS, trained

TOWERS = ("vision", "language", "action")
BASE = pi0.Config.base()
BASE = dataclasses.replace(
    BASE,
    **{name: dataclasses.replace(getattr(BASE, name), depth=2) for name in TOWERS},
    vocabulary=1000,
    param_dtype="bfloat16",
)
DUMMY = pi0.Config.dummy()
DUMMY = dataclasses.replace(DUMMY, language=dataclasses.replace(DUMMY.language, mlp=128))


def sampler(kind: Kind | None) -> Sampler:
    """Shapes of a sampler with layers of published size."""

    def make():
        model = BASE.create(nnx.Rngs(0))
        return (quantize(model, [(".*", kind)]).model if kind else model).sampler()

    return jax.eval_shape(make)


def towers(sampler):
    """Blocks of the vision tower, the language model and the action expert."""
    prefix, suffix = sampler._models()
    return prefix.vision.blocks, prefix.language.blocks, suffix.action.blocks


def quantized_shapes(module) -> list[tuple[int, ...]]:
    is_kernel = lambda leaf: isinstance(leaf, QuantizedKernel)  # noqa: E731
    leaves = jax.tree.leaves(nnx.state(module), is_leaf=is_kernel)
    return sorted(leaf.shape for leaf in leaves if is_kernel(leaf))


def nbytes(sampler) -> int:
    return sum(leaf.size * leaf.dtype.itemsize for leaf in sampler.weights)


on_hopper = functools.partial(target, "cuda", "NVIDIA H100")


def test_float8_stays_only_where_the_gpu_multiplies_it():
    """Those are gate, up and down of the language model; all else would be dequantized per call."""
    with on_hopper():
        small, large = sampler("float8"), sampler(None)
    vision, language, action = map(quantized_shapes, towers(small))
    depth = BASE.language.depth
    assert language == [(2048, 16384)] * 2 * depth + [(16384, 2048)] * depth
    assert vision == action == []
    assert nbytes(small) < 0.7 * nbytes(large)


@pytest.mark.parametrize(
    ("kind", "device"),
    [("float8", contextlib.nullcontext), ("int8", on_hopper), ("nf4", on_hopper)],
)
def test_kernels_that_only_save_memory_stay_quantized(kind, device):
    with device():
        vision, language, action = map(quantized_shapes, towers(sampler(kind)))
    assert len(vision) == 6 * BASE.vision.depth
    assert len(language) == 7 * BASE.language.depth
    assert action == []


@pytest.fixture
def in_float8(monkeypatch):
    """Multiply by the kernels of the language model's MLP in float8, though a CPU emulates it."""
    for module in ("kernels.frozen_matmul", "adapters.compress.quantization"):
        monkeypatch.setattr(f"lorasp_jax.{module}.multiplies_float8", lambda: True)
    monkeypatch.setattr(frozen_matmul, "MIN_WIDTH", 0)
    monkeypatch.setattr(frozen_matmul, "MIN_SIZE", DUMMY.language.width * DUMMY.language.mlp)
    jax.clear_caches()
    yield
    jax.clear_caches()


@pytest.mark.parametrize("adapted", [pytest.param(True, marks=pytest.mark.slow), False])
def test_a_float8_sampler_gives_the_actions_of_its_model(in_float8, adapted):
    model, obs = random_backbone(DUMMY), observation(DUMMY, 2)
    if adapted:
        model = trained((".*_proj", METHODS["lora_sp"]), seed=1, net=model, size=0.1)
    model = jax.jit(lambda model: cast(Any, quantize(model, [(".*", "float8")]).model))(model)
    shape = (2, DUMMY.chunk, DUMMY.action_dim)
    noise = np.random.default_rng(0).normal(size=shape).astype(np.float32)

    @jax.jit
    def sample(sampler):
        return sampler.sample_actions(jax.random.key(0), obs, num_steps=1, noise=noise)

    velocity = jax.jit(lambda model: model.velocity(obs, noise, np.ones(2, "f"))).trace(model)
    assert "f8_e4m3fn[2" in str(velocity.jaxpr)  # x is rounded
    expected = noise - velocity.lower().compile()(model)
    prepared = jax.jit(lambda model: model.sampler())(model)
    assert len(quantized_shapes(towers(prepared)[1])) == 3 * DUMMY.language.depth
    for sampler in (prepared, jax.jit(lambda m: Sampler.from_model(m, once=True))(model)):
        # Sums in another order; a number that rounds to another float8 differs by 1e-3 and more.
        np.testing.assert_allclose(sample(sampler), expected, rtol=1e-4, atol=5e-5)
