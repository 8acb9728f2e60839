"""Test that common mistakes of new users raise a short, one-line error that names what is wrong."""

import re

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.dense import Dense, LinenDense, dense
from lorasp_jax.peft import AdaLoRA, DoRA, FullFineTuning, LoRA, LoRAMoE, LoRASP

METHOD = LoRA(rank=2)
NET = nnx.Dict(inp=nnx.Linear(5, 4, rngs=nnx.Rngs(0)), head=nnx.Linear(4, 2, rngs=nnx.Rngs(0)))
KEY, X, KERNEL = jax.random.key(0), jnp.ones((2, 5)), jnp.ones((5, 4))
LONG = "q" * 5000
RNGS = {"rngs": nnx.Rngs(0)}
LINEN = lorasp_jax.LinenAdapter(nn.Dense(3), [("", METHOD)])


def adapted(method=METHOD, net=NET):
    return lorasp_jax.adapt(net, [("inp", method)], rngs=nnx.Rngs(0))


def check_error(call, name):
    """Check that the call raises a short one-line error that contains `name`."""
    with pytest.raises(ValueError, match=re.escape(name)) as caught:
        call()
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 800


@pytest.mark.parametrize(
    "rules",
    [
        *({"inp": METHOD}, ("inp", METHOD), "inp", [], None, [("inp",)], [(3, None)]),
        *([("inp", LoRA)], [("inp", "lora")], [("(", METHOD)]),
    ],
)
def test_rules(rules):
    """NNX, Linen and quantization check rules in the same way."""
    name = "'(' is not a regular expression" if rules == [("(", METHOD)] else "(pattern, "
    check_error(lambda: lorasp_jax.adapt(NET, rules, rngs=nnx.Rngs(0)), name)
    check_error(lambda: lorasp_jax.LinenAdapter(nn.Dense(3), rules), name)
    check_error(lambda: lorasp_jax.quantize(NET, rules), "(pattern, ")


@pytest.mark.parametrize("rngs", [jax.random.key(0), 0, None, nnx.Rngs(dropout=0)])
def test_rngs(rngs):
    check_error(lambda: lorasp_jax.adapt(NET, [("inp", METHOD)], rngs=rngs), "nnx.Rngs")


@pytest.mark.parametrize(
    ("call", "name"),
    [
        *[(lambda d=d: Dense(*d, **RNGS), n) for d, n in (((2.5, 3), "d_in"), ((3, 0), "d_out"))],
        *[(lambda m=m: Dense(5, 3, method=m, **RNGS), "method") for m in ("lora", LoRA)],
        (lambda: Dense(5, 3, rngs=KEY), "rngs"),
        (lambda: Dense(5, 3, param_dtype="x", **RNGS), "param_dtype"),
        (lambda: Dense(5, 3, dtype=int, **RNGS), "dtype"),
        (lambda: Dense(5, 3, **RNGS)([1.0]), "[...tokens, I]"),
        (lambda: LinenDense(2.5).init(KEY, X), "features"),
        (lambda: LinenDense(3, method="lora").init(KEY, X), "'lora'"),
        *[(lambda k=k: dense(X, k), "kernel") for k in (None, jnp.ones(5))],
        *[(lambda b=b: dense(X, KERNEL, b), "bias") for b in (jnp.ones(3), 5)],
        *[(lambda a=a: dense(X, KERNEL, None, *a), "together") for a in (({},), (None, METHOD))],
        (lambda: dense(X, KERNEL, None, {"a": 1}, METHOD), "lora_a"),
        (lambda: dense(X, KERNEL, token_mask=[True, True]), "bool [2]"),
        *[
            (lambda m=m, k=k: m.init(KEY, k), "kernel [I, O]")
            for m in (METHOD, DoRA(2), LoRA(2, initialization="pissa"), AdaLoRA(2), LoRASP(4))
            for k in (None, jnp.ones((0, 3)), jnp.ones((3, 3), int))
        ],
    ],
)  # fmt: skip
def test_layers(call, name):
    check_error(call, name)


def test_kernels_that_cannot_be_adapted():
    """Errors name the path: an empty kernel, one axis, not an array, no kernel."""
    zeros = nnx.initializers.zeros
    empty = nnx.Dict(inp=nnx.Linear(0, 3, kernel_init=zeros, rngs=nnx.Rngs(0)))
    check_error(lambda: adapted(net=empty), "adapt inp")
    net = nnx.clone(NET)
    for value in (jnp.ones(3), "abc"):
        net["inp"].kernel.set_value(value)
        check_error(lambda: adapted(net=net), "adapt inp")
    net["inp"].kernel = None
    check_error(lambda: adapted(net=net), "adapt inp")


def test_8_bit_kernels_need_a_compute_dtype():
    kind = {"param_dtype": jnp.float8_e4m3fn, "rngs": nnx.Rngs(0)}
    net = nnx.Dict(inp=nnx.Linear(5, 4, **kind))
    check_error(lambda: adapted(net=net)["inp"](X), "float8_e4m3fn kernel")
    net = nnx.Dict(inp=nnx.Linear(5, 4, dtype=jnp.float32, **kind))
    np.testing.assert_allclose(adapted(net=net)["inp"](X), net["inp"](X), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("method", [METHOD, LoRAMoE(2, 2), LoRASP(4, hidden_width=4)])
def test_no_tokens(method):
    """Losses and ranks are 0; the output of a Linen model has no rows."""
    params, _ = method.init(KEY, KERNEL)
    y, aux = method.apply(params, jnp.zeros((0, 5)), KERNEL)
    assert y.shape == (0, 4)
    assert not any(aux.losses[name] for name in aux.losses)
    assert aux.mean_active_rank() == 0
    adapter = lorasp_jax.LinenAdapter(nn.Dense(3), [("", method)])
    assert adapter.apply(adapter.init(KEY, X), jnp.zeros((0, 5))).shape == (0, 3)


@pytest.mark.parametrize("variables", [{}, None, {"params": 5}, {"adapters": {}}])
def test_linen_variables(variables):
    for call in (LINEN.apply, LINEN.merge, lambda *args: LINEN.attach(KEY, *args)):
        check_error(lambda call=call: call(variables, X), "variables")


def test_linen_adapters_of_another_width():
    variables = LINEN.init(KEY, X)
    narrow = jax.tree.map(lambda a: a[:1], variables["adapters"])
    check_error(lambda: LINEN.apply(variables | {"adapters": narrow}, X), "lora_a [5, 2]")


@pytest.mark.parametrize("model", [5, nn.Dense(3), {}])
def test_not_a_model(model, tmp_path):
    for call in (
        lambda: lorasp_jax.adapt(model, [("inp", METHOD)], rngs=nnx.Rngs(0)),
        lambda: lorasp_jax.summary(model),
        lambda: lorasp_jax.merge(model),
        lambda: lorasp_jax.split(model),
        lambda: lorasp_jax.quantize(model, [("inp", "nf4")]),
        lambda: lorasp_jax.save_adapters(tmp_path, model),
        lambda: lorasp_jax.load_peft(tmp_path, model),
        lambda: lorasp_jax.unmerge(NET, model),
        lambda: lorasp_jax.combine({"a": model}),
        lambda: lorasp_jax.prune(model, [X]),
    ):
        check_error(call, "NNX module")


def test_abstract_models(tmp_path):
    """Abstract models can be adapted and counted, but not called."""
    model = nnx.eval_shape(adapted)
    assert lorasp_jax.summary(model)
    for call in (
        lambda: lorasp_jax.merge(model),
        lambda: lorasp_jax.quantize(model, [("head", "nf4")]),
        lambda: lorasp_jax.unmerge(NET, model),
        lambda: lorasp_jax.save_adapters(tmp_path, model),
        lambda: lorasp_jax.save_peft(tmp_path, model),
    ):
        check_error(call, "shapes without values")


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda _: lorasp_jax.summary(adapted(), {"nowhere": 5}), "nowhere"),
        (lambda _: lorasp_jax.auxiliary_losses({"a": 5}), "Aux"),
        (lambda _: lorasp_jax.with_dropout(NET, 5), "PRNG key"),
        (lambda _: lorasp_jax.combine({}), "models"),
        (lambda _: lorasp_jax.extract(lorasp_jax.combine({"a": adapted()}), "b"), "'b'"),
        (lambda _: lorasp_jax.save_adapters(5, adapted()), "folder"),
        (lambda _: lorasp_jax.save_adapters("gs://x/y", adapted()), "URL"),
        (lambda f: lorasp_jax.load_peft(f / LONG, NET), "255 bytes"),
        (lambda f: lorasp_jax.save_adapters(f, adapted(), base=5), "base"),
        (
            lambda f: lorasp_jax.save_peft(
                f, lorasp_jax.adapt(NET, [(".*", METHOD)], **RNGS), names=lambda *_: "one"
            ),
            "'one'",
        ),
    ],
)
def test_other_arguments(call, name, tmp_path):
    check_error(lambda: call(tmp_path / "new"), name)
    assert not (tmp_path / "new").exists()


def test_long_values_are_truncated():
    check_error(lambda: lorasp_jax.adapt(NET, [(LONG, METHOD)], **RNGS), "qqq")
    check_error(lambda: LoRA(initialization=LONG), "qqq")


def test_full_fine_tuning_of_an_adapted_kernel():
    rules = [("kernel$", FullFineTuning()), ("inp", METHOD)]
    check_error(lambda: lorasp_jax.adapt(NET, rules, **RNGS), "inp/kernel")
