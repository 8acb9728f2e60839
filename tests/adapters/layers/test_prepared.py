"""Fused layers give the outputs of the original ones, with fewer matmuls."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from lorasp_jax.adapters.compress.quantization import dequantize, quantize
from lorasp_jax.adapters.layers import prepared
from lorasp_jax.dense import Dense
from lorasp_jax.models import pi0, smolvla
from lorasp_jax.models.sampling import Sampler
from lorasp_jax.models.transformer.layers import apply_to_shared_input
from lorasp_jax.peft import LoRASP
from tests.cases import mostly_slow
from tests.models.random_models import observation, random_backbone, with_random_parameters
from tests.nets import METHODS, trained
from tests.peft.lora_sp.test_method import WithFusedKernel

FUSABLE = [name for name in METHODS if name not in ("full", "dora", "lora_moe")]


class Net(nnx.Module):
    """Two layers with a shared input, one of them with a bias, and a third one."""

    shared_inputs = (("first", "second"),)

    def __init__(self, dtype="bfloat16"):
        options = {"dtype": dtype, "rngs": nnx.Rngs(0)}
        self.first = Dense(8, 8, **options, use_bias=False)
        self.second = Dense(8, 12, **options)
        self.third = Dense(8, 8, **options)

    def __call__(self, x, token_mask=None):
        (first, second), aux = apply_to_shared_input(
            x, token_mask, first=self.first, second=self.second
        )
        y, aux["third"] = self.third(first, token_mask=token_mask, return_aux=True)
        return y + second[..., :8], aux


X = np.sin(np.arange(96, dtype="f")).reshape(2, 6, 8)


def random_net(dtype="bfloat16"):
    return with_random_parameters(lambda: Net(dtype))


def adapted(method, dtype="bfloat16"):
    return trained((".*", method), seed=1, net=random_net(dtype))


@functools.partial(jax.jit, static_argnums=1)
def prepare(model, copy_kernels=True):
    model = nnx.merge(*nnx.split(model))
    prepared.fuse_projections(model, copy_kernels=copy_kernels)
    return model


@functools.partial(jax.jit, static_argnums=2)
def prepared_and_original(model, x, copy_kernels=True):
    """Results of the prepared model and of the original one, from one program."""
    return prepare(model, copy_kernels)(x), model(x)


def fused_arrays(model):
    """Shapes of the arrays stored at the first layer."""
    return jax.eval_shape(prepare, model).first.fused.get_value()


def fused_counts(model):
    """Number of fused layers stored at each layer; 0 for unchanged and empty ones."""
    variables = [
        getattr(layer, "fused", None) for layer in (model.first, model.second, model.third)
    ]
    values = [None if variable is None else variable.get_value() for variable in variables]
    return [0 if value is None else len(value.bottleneck.out_sizes) for value in values]


@pytest.mark.parametrize("name", mostly_slow(FUSABLE, ["lora_sp"]))
def test_fused_layers_match_the_original_ones(name):
    model, mask = adapted(METHODS[name], "float32"), np.arange(12).reshape(2, 6) % 5 != 0
    assert fused_counts(jax.eval_shape(prepare, model)) == [2, 0, 1]
    both = jax.jit(lambda model: (prepare(model)(X, mask), model(X, mask)))
    (actual, actual_aux), (expected, aux) = both(model)
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-4)
    assert jax.tree.structure(actual_aux) == jax.tree.structure(aux)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), actual_aux, aux
    )


@pytest.mark.parametrize("rank", mostly_slow([4, 13], [13]))
def test_wide_layers_match_the_original_ones(monkeypatch, rank):
    """They join x and z instead of adding z U in another pass; [W; U] is aligned for GPUs."""
    monkeypatch.setattr(prepared, "MAX_FUSED_OUTPUTS", 1)
    model = adapted(LoRASP(rank=rank, hidden_width=4), "float32")
    arrays = fused_arrays(model)
    assert isinstance(arrays, prepared.SharedProjection)
    assert [kernel.shape[0] for kernel in arrays.kernels] == [8 + rank + -rank % 8] * 2
    close = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4)
    jax.tree.map(close, *prepared_and_original(model, X))


@pytest.mark.parametrize("name", mostly_slow(FUSABLE, ["lora_sp"]))
def test_fused_stack_matches_the_original_one(name):
    """Check inputs with fewer and with more rows than features."""
    model = adapted(METHODS[name], "float32")
    stack = jax.tree.map(lambda leaf: np.stack([leaf, 0.5 * np.asarray(leaf)]), model)
    mapped = jax.vmap(lambda model, x: model(x), in_axes=(0, None))
    xs = X[:1, :4], X.reshape(1, 12, 8)
    both = lambda stack: [(mapped(stack, x), mapped(prepared.fuse_stack(stack), x)) for x in xs]  # noqa: E731
    for (expected, aux), (actual, actual_aux) in jax.jit(both)(stack):
        np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-4)
        assert jax.tree.structure(actual_aux) == jax.tree.structure(aux)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), actual_aux, aux)


def test_adapters_of_a_stack_are_cast_before_the_loop():
    stack = jax.tree.map(lambda leaf: np.asarray(leaf)[None], adapted(METHODS["lora"]))
    x = X[0].astype(jnp.bfloat16)

    def in_loop(primitive, stack):
        run = lambda x, stack: jax.lax.scan(lambda x, model: (model(x)[0], None), x, stack)  # noqa: E731
        (loop,) = (e for e in jax.make_jaxpr(run)(x, stack).eqns if e.primitive.name == "scan")
        return str(loop.params["jaxpr"]).count(primitive)

    fused = jax.eval_shape(prepared.fuse_stack, stack)
    casts = [in_loop("convert_element_type", one) for one in (stack, fused)]
    assert casts[0] - casts[1] >= 6  # P and U of three layers
    assert in_loop("optimization_barrier", fused) == 2  # one for each input


def test_fused_kernel_gets_packed_router_parameters():
    sizes = {"rank": 32, "hidden_width": 16}
    model, expected = (adapted(m(**sizes), "float32") for m in (WithFusedKernel, LoRASP))
    params = fused_arrays(model).params
    assert [leaf.shape for leaf in jax.tree.leaves(params)] == [(2, 16 * 32 + 16 + 32)]
    close = functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-4)
    both = jax.jit(lambda model, expected: (prepare(model)(X), expected(X)))
    jax.tree.map(close, *both(model, expected))


@pytest.mark.parametrize("copy_kernels", [True, False])
def test_fused_layers_stay_quantized(copy_kernels):
    model = quantize(adapted(METHODS["lora"], "float32"), [(".*", "int8")]).model
    fused = jax.eval_shape(lambda model: prepare(model, copy_kernels), model)
    assert fused_counts(fused) == [2, 0, 1]
    codes = [leaf for leaf in jax.tree.leaves(nnx.state(fused)) if leaf.dtype == jnp.int8]
    assert len(codes) == 3
    (actual, _), (expected, _) = prepared_and_original(model, X, copy_kernels)
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("rows", "d_in", "d_out", "splits"),
    [
        (51, 4096, 1184, 8),  # the action expert's last matmul
        (51, 2048, 1184, 4),
        (51, 1024, 8512, 1),  # few inputs
        (816, 4096, 2208, 1),  # many tiles
        (51, 2050, 64, 1),  # not divisible
    ],
)
def test_split_k_for_few_rows_and_many_inputs(rows, d_in, d_out, splits):
    assert prepared._num_splits(rows, d_in, d_out) == splits


def test_split_k_equals_matmul():
    rng = np.random.default_rng(0)
    x, matrix = (rng.normal(size=s).astype("f") for s in ((2, 3, 4096), (4096, 8)))
    assert "reduce_sum" in str(jax.make_jaxpr(prepared.matmul)(x, matrix))
    matmul = jax.jit(prepared.matmul)
    np.testing.assert_allclose(matmul(x, matrix), x @ matrix, rtol=1e-4, atol=1e-3)
    half = matmul(x.astype(jnp.bfloat16), matrix.astype(jnp.bfloat16))
    assert half.dtype == jnp.bfloat16
    np.testing.assert_allclose(np.asarray(half, "f"), x @ matrix, atol=1)


def matmuls(model, x):
    return str(jax.make_jaxpr(lambda model, x: model(x)[0])(model, x)).count("dot_general")


def test_layers_with_a_shared_input_run_two_matmuls():
    model, x = adapted(METHODS["lora"]), X[0].astype(jnp.bfloat16)
    assert matmuls(model, x) > matmuls(jax.eval_shape(prepare, model), x) == 4


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_layers_without_adapters_share_one_matmul(dtype):
    model, x = random_net(dtype), X[0].astype(dtype)
    fused = jax.eval_shape(prepare, model)
    assert (type(fused.first), type(fused.third)) == (prepared.Prepared, Dense)
    assert (matmuls(model, x), matmuls(fused, x)) == (3, 2)
    (actual, actual_aux), (expected, aux) = prepared_and_original(model, x)
    assert actual.dtype == expected.dtype
    np.testing.assert_allclose(*(np.asarray(y, "f") for y in (actual, expected)), rtol=1e-2)
    assert jax.tree.structure(actual_aux) == jax.tree.structure(aux)


@pytest.mark.parametrize("kind", ["float8", "int8", "nf4"])
def test_quantized_layers_are_fused_after_they_are_dequantized(kind):
    model = quantize(random_net("float32"), [(".*", kind)]).model
    assert type(jax.eval_shape(prepare, model).first) is Dense

    @jax.jit
    def run(model):
        fused = nnx.clone(model)
        dequantize(fused)
        fused = prepare(fused)
        return fused, fused(X), model(X)

    fused, (actual, _), (expected, _) = run(model)
    assert (type(fused.first), type(fused.third)) == (prepared.Prepared, Dense)
    assert {leaf.dtype for leaf in jax.tree.leaves(nnx.state(fused))} == {jnp.dtype("float32")}
    np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-5)


def test_layers_without_adapters_are_not_fused_if_that_would_copy():
    model = random_net("float32")
    prepared.fuse_projections(model, copy_kernels=False)
    assert type(model.first) is Dense
    model.second.dtype = "bfloat16"
    prepared.fuse_projections(model)
    assert type(model.first) is Dense


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        ("dora", "bfloat16"),  # overrides `apply`
        ("lora_moe", "bfloat16"),  # down-projects in fp32
        ("lora", None),  # has no explicit dtype
    ],
)
def test_other_layers_are_unchanged(name, dtype):
    model = jax.eval_shape(prepare, adapted(METHODS[name], dtype))
    assert {type(layer) for layer in (model.first, model.second, model.third)} == {Dense}


@pytest.mark.parametrize("second", ["ada_lora", "dora", None])
def test_layers_of_two_methods_are_fused_individually(second):
    """The second layer is unchanged if its method is DoRA or if it has no adapter."""
    rules = [("second", second and METHODS[second]), (".*", METHODS["lora"])]
    model = trained(*rules, seed=1, net=random_net("float32"))
    assert fused_counts(jax.eval_shape(prepare, model)) == [1, int(second == "ada_lora"), 1]
    (actual, actual_aux), (expected, aux) = prepared_and_original(model, X)
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-4)
    assert jax.tree.structure(actual_aux) == jax.tree.structure(aux)


@pytest.mark.parametrize("adapted", mostly_slow([True, False], [True]), ids=["adapted", "bare"])
@pytest.mark.parametrize("backbone", mostly_slow([pi0, smolvla], [pi0]), ids=["pi0", "smolvla"])
def test_sampling_follows_the_velocity(backbone, adapted):
    config = backbone.Config.dummy()
    model = random_backbone(config)
    if adapted:
        model = trained((".*_proj", METHODS["lora"]), seed=1, net=model, size=0.1)
    obs = observation(config, 2)
    noise = np.random.default_rng(0).normal(size=(2, config.chunk, config.action_dim)).astype("f")
    velocity = jax.jit(lambda model, x, t: model.velocity(obs, x, jnp.full(2, t)))
    expected = noise - np.asarray(velocity(model, noise, 1.0)) / 2
    expected -= np.asarray(velocity(model, expected, 0.5)) / 2
    sampler = jax.jit(Sampler.from_model, static_argnames="once")
    traced = []

    @jax.jit
    def sample(sampler):
        traced.append(type(sampler))
        return sampler.sample_actions(jax.random.key(0), obs, num_steps=2, noise=noise)

    for _ in range(2):
        np.testing.assert_allclose(sample(sampler(model)), expected, rtol=1e-4, atol=1e-5)
    assert traced == [Sampler]  # samplers of one model share a compiled function
    np.testing.assert_allclose(sample(sampler(model, once=True)), expected, rtol=1e-4, atol=1e-5)
