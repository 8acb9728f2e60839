"""`Dense` and `LinenDense`, drop-ins for nnx.Linear and nn.Dense, and their aux."""

import sys

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.dense import AdapterParam, Dense, LinenDense, dense, dense_shared_input
from lorasp_jax.peft import DoRA, FullFineTuning, LoRA, LoRASP
from tests.models.random_models import with_random_parameters

METHOD = LoRASP(rank=8, hidden_width=4)


class Net(nnx.Module):
    """A model written without adapters in mind, which expects one result per layer."""

    def __init__(self, method, rngs):
        self.first = Dense(5, 6, method=method, rngs=rngs)
        self.last = Dense(6, 3, method=method, use_bias=False, rngs=rngs)

    def __call__(self, x):
        return self.last(jnp.tanh(self.first(x)))


@pytest.fixture(scope="module")
def x():
    return np.random.default_rng(0).normal(size=(4, 5)).astype("f")


@pytest.fixture
def net():
    return with_random_parameters(lambda: Net(METHOD, nnx.Rngs(0)))


def test_equals_nnx_linear(x):
    linear = nnx.Linear(5, 6, bias_init=nnx.initializers.normal(), rngs=nnx.Rngs(1))
    layer = Dense(5, 6, rngs=nnx.Rngs(0))
    layer.kernel, layer.bias = linear.kernel, linear.bias
    np.testing.assert_allclose(layer(x), linear(x), rtol=1e-5, atol=1e-5)
    assert Dense(5, 6, rngs=nnx.Rngs(1)).kernel.get_value().std() == pytest.approx(
        linear.kernel.get_value().std()
    )


def test_layers_with_a_shared_input(x):
    """Each layer gives the same result as alone, for any mix of methods, including none."""
    methods = [LoRA(rank=2), None, METHOD, DoRA(rank=2), LoRA(rank=3)]
    mask = np.arange(4) != 1
    build = lambda: nnx.List(  # noqa: E731
        [Dense(5, 6 + i, method=m, rngs=nnx.Rngs(i)) for i, m in enumerate(methods)]
    )

    @jax.jit
    def run(layers, x):
        shared = dense_shared_input(x, [layer.arrays() for layer in layers], token_mask=mask)
        return shared, [layer(x, token_mask=mask, return_aux=True) for layer in layers]

    for (y, aux), (alone, expected) in zip(*run(with_random_parameters(build), x), strict=True):
        np.testing.assert_allclose(y, alone, rtol=1e-5, atol=1e-5)
        assert jax.tree.structure(aux) == jax.tree.structure(expected)
        for a, b in zip(jax.tree.leaves(aux), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


def test_linen_equals_nnx(x):
    linen = LinenDense(6, method=METHOD)
    variables = jax.jit(linen.init)(jax.random.key(0), x)
    assert set(variables) == {"params", "adapters"}
    adapter = variables["adapters"]["adapter"]
    adapter["bank"]["u"] = jax.random.normal(jax.random.key(1), (8, 6))
    layer = Dense(5, 6, method=METHOD, rngs=nnx.Rngs(0))
    layer.kernel.set_value(variables["params"]["kernel"])
    layer.adapter.set_value(adapter)
    y, state = jax.jit(lambda v, x: linen.apply(v, x, mutable=["intermediates"]))(variables, x)
    np.testing.assert_allclose(y, layer(x), rtol=1e-5, atol=1e-5)
    ours, theirs = lorasp_jax.collect_aux(layer)[""], lorasp_jax.collect_aux(state)[""]
    np.testing.assert_array_equal(ours.active_rank, theirs.active_rank)
    base = nn.Dense(6).apply({"params": variables["params"]}, x)
    assert jnp.abs(y - base).max() > 0.1


def test_linen_adapts_inside_a_model(x):
    class Outer(nn.Module):
        @nn.compact
        def __call__(self, x):
            return LinenDense(3, method=METHOD)(LinenDense(6)(x))

    model = Outer()
    variables = jax.jit(model.init)(jax.random.key(0), x)
    _, state = jax.jit(lambda v: model.apply(v, x, mutable=["intermediates"]))(variables)
    assert set(lorasp_jax.collect_aux(state)) == {"LinenDense_0"}
    with pytest.raises(ValueError, match="no adapted layer stored any aux"):
        lorasp_jax.collect_aux({"params": variables["params"]})


def test_collect_aux_eagerly_only_once(net, x):
    net(x)
    aux = lorasp_jax.collect_aux(net)
    assert set(aux) == {"first", "last"}
    assert aux["first"].active_rank.shape == (4,)
    with pytest.raises(ValueError, match="no adapted layer stored any aux"):
        lorasp_jax.collect_aux(net)


def test_collect_aux_under_jit_and_grad(net, x):
    graphdef, adapters, frozen = nnx.split(net, AdapterParam, ...)

    def loss(adapters):
        model = nnx.merge(graphdef, adapters, frozen)
        y = model(x)
        aux = lorasp_jax.collect_aux(model)
        return jnp.sum(y**2) + sum(a.losses["balance"] for a in aux.values()), aux

    gradients, aux = jax.jit(jax.grad(loss, has_aux=True))(adapters)
    assert aux["last"].active_rank.shape == (4,)
    first = gradients["first"]["adapter"].get_value()
    assert jnp.abs(first["bank"]["u"]).max() > 0
    assert jnp.abs(first["router"]["w2"]).max() > 0


def test_model_in_a_closure_is_callable(net, x):
    for y in (jax.jit(net.__call__)(x), jax.jit(lambda net, x: net(x))(net, x)):
        np.testing.assert_allclose(y, net(x), rtol=1e-5, atol=1e-5)


def test_returned_aux_is_not_stored(net, x):
    before = nnx.graphdef(net)
    y, aux = net.first(x, token_mask=jnp.array([True, True, False, True]), return_aux=True)
    assert (y.shape, aux.token_mask.sum()) == ((4, 6), 3)
    assert nnx.graphdef(net) == before


def test_full_fine_tuning_trains_the_layer_itself(x):
    layer = Dense(5, 6, method=FullFineTuning(), rngs=nnx.Rngs(0))
    graphdef, trained, rest = nnx.split(layer, AdapterParam, ...)
    assert set(trained) == {"kernel", "bias"}
    assert not jax.tree.leaves(rest)
    gradient = jax.jit(jax.grad(lambda t: nnx.merge(graphdef, t, rest)(x).sum()))(trained)
    expected = np.broadcast_to(x.sum(0)[:, None], (5, 6))
    np.testing.assert_allclose(gradient["kernel"].get_value(), expected, rtol=1e-5, atol=1e-5)
    linen = LinenDense(6, method=FullFineTuning())
    assert set(jax.eval_shape(linen.init, jax.random.key(0), x)) == {"params"}


def test_kernels_with_several_output_axes(x):
    """An einsum kernel [I, N, H] is a matrix with N·H outputs."""
    kernel = np.random.default_rng(1).normal(size=(5, 2, 3)).astype("f")
    params, _ = jax.jit(METHOD.init)(jax.random.key(2), kernel.reshape(5, 6))
    y, aux = jax.jit(dense, static_argnums=4)(x, kernel, np.ones((2, 3), "f"), params, METHOD)
    np.testing.assert_allclose(y, np.einsum("bi,inh->bnh", x, kernel) + 1, rtol=1e-5, atol=1e-5)
    assert aux.active_rank.shape == (4,)


@pytest.mark.parametrize(
    ("dtype", "param_dtype", "expected"),
    [(None, jnp.bfloat16, jnp.float32), (jnp.bfloat16, jnp.float32, jnp.bfloat16)],
)
def test_compute_dtype(x, dtype, param_dtype, expected):
    layer = Dense(5, 6, method=METHOD, dtype=dtype, param_dtype=param_dtype, rngs=nnx.Rngs(0))
    assert jax.eval_shape(layer, x).dtype == expected
    assert layer.kernel.get_value().dtype == param_dtype
    dtypes = {leaf.dtype for leaf in jax.tree.leaves(layer.adapter.get_value())}
    assert dtypes == {jnp.dtype("float32")}


def test_wrong_input_width(net):
    with pytest.raises(ValueError, match=r"input width 7 does not match kernel shape \[5, 6\]"):
        net(jnp.ones((2, 7)))


@pytest.mark.parametrize(("method", "limit"), [(LoRA(rank=4), 50), (LoRASP(rank=4), 160)])
def test_program_size_per_layer(method, limit):
    """Operations that each further layer adds to the lowered gradient: equal layers share code."""

    def count_operations(depth):
        rngs = nnx.Rngs(0)
        model = nnx.List([Dense(8, 8, method=method, rngs=rngs) for _ in range(depth)])
        graphdef, adapters, frozen = nnx.split(model, AdapterParam, ...)

        def loss(adapters, x):
            total = 0.0
            for layer in nnx.merge(graphdef, adapters, frozen):
                x, aux = layer(x, return_aux=True)
                total += sum(aux.losses.values())
            return x.sum() + total

        return jax.jit(jax.grad(loss)).lower(adapters, jnp.ones((5, 8))).as_text().count(" = ")

    assert (count_operations(6) - count_operations(3)) / 3 <= limit


@pytest.mark.parametrize("method", [LoRA(rank=2), LoRASP(rank=2, hidden_width=2)])
@pytest.mark.parametrize(
    ("x", "mask", "message"),
    [
        (jnp.ones((2, 4), int), None, r"floating-point array .* got int32 \[2, 4\]"),
        (jnp.ones(()), None, r"got float32 \[\]"),
        ([[1.0] * 4], None, r"must be an array .* got \[\["),
        (jnp.ones((2, 4)), jnp.ones((3, 3), bool), r"bool \[2\], got bool \[3, 3\]"),
        (jnp.ones((2, 4)), jnp.ones(2), r"bool \[2\], got float32 \[2\]"),
    ],
)
def test_invalid_inputs(method, x, mask, message):
    kernel = jnp.ones((4, 3))
    params, kernel = method.init(jax.random.key(0), kernel)
    with pytest.raises(ValueError, match=message):
        dense(x, kernel, None, params, method, token_mask=mask)


def test_the_calls_from_a_layer_to_the_router():
    """Who follows x from a layer reaches eq. (10) in eight calls, and only one of them checks."""
    layer = Dense(3, 5, method=LoRASP(rank=7, hidden_width=3), rngs=nnx.Rngs(0))
    all_calls, calls = [], []

    def profile(frame, event, _):
        name, own = frame.f_code.co_name, frame.f_globals.get("__name__", "")
        if event != "call" or not own.startswith("lorasp_jax.") or name.startswith("<"):
            return
        if "router_scores" in calls:
            return
        all_calls.append(name)
        arguments = frame.f_locals.values()
        is_x = any(getattr(a, "shape", ())[:1] == (11,) for a in arguments)
        if is_x:
            calls.append(name)  # it gets x, or what was computed from x for the same 11 tokens

    sys.setprofile(profile)
    try:
        layer(jnp.ones((11, 3)), token_mask=jnp.ones(11, bool))
    finally:
        sys.setprofile(None)
    path = "__call__ cast_input apply_layer apply low_rank_matmul bottlenecks bottleneck"
    assert calls == [*path.split(), "router_scores"]
    assert len(all_calls) <= 40  # with those that get parameters only, such as `check_params`


def test_replaced_parameters_of_another_rank_are_refused():
    layer = Dense(3, 5, method=LoRA(rank=4, alpha=4), rngs=nnx.Rngs(0))
    params = LoRA(rank=2, alpha=4).init_params(jax.random.key(0), 3, 5)
    layer.adapter.set_value(params)
    with pytest.raises(ValueError, match="needs"):
        layer(jnp.ones((11, 3)))
    with pytest.raises(ValueError, match="needs"):
        LoRA(rank=4).delta(params, jnp.ones((11, 3)))
    with pytest.raises(ValueError, match="int32"):
        LoRA(rank=2).delta(params, jnp.ones((11, 3), jnp.int32))
