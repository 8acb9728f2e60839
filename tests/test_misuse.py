"""Test that common mistakes of new users raise a one-sentence error that says what is valid."""

import re
from pathlib import Path

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax import peft
from lorasp_jax.dense import Dense, LinenDense, dense
from lorasp_jax.peft import AdaLoRA, DoRA, FullFineTuning, LoRA, LoRAMoE, LoRASP

METHOD = LoRA(rank=2)
NET = nnx.Dict(inp=nnx.Linear(5, 4, rngs=nnx.Rngs(0)), head=nnx.Linear(4, 2, rngs=nnx.Rngs(0)))


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ({"inp": METHOD}, "got a dict: pass list(rules.items())"),
        (("inp", METHOD), "write [(pattern, ...)] for a single rule"),
        ("inp", "pairs, got 'inp'"),
        ([], "pairs, got an empty list"),
        (None, "pairs, got None"),
        ([("inp",)], "got the item ('inp',)"),
        ([(3, None)], "got the item (3, None)"),
        ([("inp", LoRA)], "rule 'inp' has the class LoRA: write LoRA()"),
        ([("inp", "lora")], "rule 'inp' must have method or None, got 'lora'"),
        ([("(", METHOD)], "rule '(' is not a valid regular expression"),
        ([("a{99999999999}", METHOD)], "is not a valid regular expression: the repetition number"),
    ],
)
def test_rules(rules, message):
    """NNX, Linen and quantization check rules in the same way."""
    with pytest.raises(ValueError, match=re.escape(message)):
        lorasp_jax.adapt(NET, rules, rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match=re.escape(message)):
        lorasp_jax.LinenAdapter(nn.Dense(3), rules)
    if not isinstance(rules, list):
        with pytest.raises(ValueError, match=re.escape(message)):
            lorasp_jax.quantize(NET, rules)


@pytest.mark.parametrize(
    ("rngs", "given"),
    [
        (jax.random.key(0), "PRNGKeyArray"),
        (0, "int"),
        (None, "NoneType"),
        (nnx.Rngs(dropout=0), "['dropout']"),
    ],
)
def test_rngs(rngs, given):
    with pytest.raises(ValueError, match=re.escape(f"such as nnx.Rngs(0), got {given}")):
        lorasp_jax.adapt(NET, [("inp", METHOD)], rngs=rngs)


def test_models_of_other_libraries():
    with pytest.raises(ValueError, match="got Dense; for a Linen module use LinenAdapter"):
        lorasp_jax.adapt(nn.Dense(3), [("inp", METHOD)], rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="must be an NNX module, got dict"):
        lorasp_jax.adapt({"inp": NET.inp}, [("inp", METHOD)], rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="must be a Linen module, got Dict; for NNX modules use"):
        lorasp_jax.LinenAdapter(NET, [("inp", METHOD)])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: lorasp_jax.combine([m]), "must be a non-empty mapping from name"),
        (lambda m: lorasp_jax.combine({"a": m}, rank=2.5), "rank must be an integer from 0 to"),
        (lambda m: lorasp_jax.combine({"a": m}, rank=-1), "or None, got -1"),
        (lambda m: lorasp_jax.choose(lorasp_jax.combine({"a": m}), 3), "choice must be a name"),
        (
            lambda m: lorasp_jax.choose(lorasp_jax.combine({"a": m}), {"a": float("nan")}),
            "the weight of 'a' must be a finite number, got nan",
        ),
        (lambda m: lorasp_jax.extract(lorasp_jax.combine({"a": m}), 3), "unknown adapter 3"),
        (lambda m: lorasp_jax.prune(m, [], "x"), "tolerance must be in [0, 1), got 'x'"),
        (lambda m: lorasp_jax.distill(m, [], 2.5), "must be an integer of at least 1, or None"),
    ],
)
def test_combining_and_compressing(call, message):
    model = lorasp_jax.adapt(NET, [("inp", METHOD)], rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match=re.escape(message)):
        call(model)


KEY, X, KERNEL = jax.random.key(0), jnp.ones((2, 5)), jnp.ones((5, 4))
LONG = "q" * 5000
RNGS = {"rngs": nnx.Rngs(0)}


def adapted(method=METHOD, net=NET):
    return lorasp_jax.adapt(net, [("inp", method)], rngs=nnx.Rngs(0))


def check_error(call, message):
    """Check that the call raises a short one-sentence error."""
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        call()
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 800


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Dense(2.5, 3, **RNGS), "d_in must be an integer from 1 to 1048576, got 2.5"),
        (lambda: Dense(3, True, **RNGS), "d_out must be an integer"),
        (lambda: Dense(0, 3, **RNGS), "got 0"),
        (lambda: Dense(5, 3, method="lora", **RNGS), "LoRA(rank=8), got 'lora'; `peft.create`"),
        (lambda: Dense(5, 3, method=LoRA, **RNGS), "write LoRA()"),
        (lambda: Dense(5, 3, rngs=KEY), "rngs must be nnx.Rngs with a params or default stream"),
        (lambda: Dense(5, 3, param_dtype="x", **RNGS), "param_dtype must be a floating-point"),
        (lambda: Dense(5, 3, dtype=int, **RNGS), "dtype must be a floating-point dtype"),
        (lambda: Dense(5, 3, **RNGS)([1.0]), "x must be an array [...tokens, I], got [1.0]"),
        (lambda: LinenDense(2.5).init(KEY, X), "features must be an integer"),
        (lambda: LinenDense(3, method="lora").init(KEY, X), "got 'lora'"),
        (lambda: LinenDense(3).init(KEY, None), "x must be an array"),
        (lambda: dense(X, None), "kernel must be an array [I, *O], got None"),
        (lambda: dense(X, jnp.ones(5)), "kernel must be an array [I, *O], got float32 [5]"),
        (lambda: dense(X, KERNEL, jnp.ones(3)), "bias must be an array [4], got float32 [3]"),
        (lambda: dense(X, KERNEL, 5), "bias must be an array [4], got 5"),
        (lambda: dense(X, KERNEL, None, {}), "params and method must be given together"),
        (lambda: dense(X, KERNEL, None, None, METHOD), "params and method must be given together"),
        (lambda: dense(X, KERNEL, None, {"a": 1}, METHOD), "needs lora_a [5, 2], got none"),
        (
            lambda: dense(X, KERNEL, None, METHOD.init(KEY, jnp.ones((3, 4)))[0], METHOD),
            "lora for a kernel [5, 4] needs lora_a [5, 2], got [3, 2]",
        ),
        (lambda: dense(X, KERNEL, token_mask=[True, True]), "must be bool [2], got list [2]"),
        *[
            (lambda m=m, k=k: m.init(KEY, k), "an adapter needs a floating-point kernel [I, O]")
            for m in (METHOD, DoRA(2), LoRA(2, initialization="pissa"), AdaLoRA(2), LoRASP(4))
            for k in (None, jnp.ones(3), jnp.ones((0, 3)), jnp.ones((3, 3), int))
        ],
    ],
)
def test_layers(call, message):
    check_error(call, message)


def test_kernels_that_cannot_be_adapted():
    """Errors name the path: an empty kernel, one axis, not an array, no kernel."""
    zeros = nnx.initializers.zeros
    for d_in, d_out in ((0, 3), (3, 0)):
        net = nnx.Dict(inp=nnx.Linear(d_in, d_out, kernel_init=zeros, rngs=nnx.Rngs(0)))
        check_error(lambda net=net: adapted(net=net), "cannot adapt inp: an adapter needs a")
    for value in (jnp.ones(3), "abc"):
        net = nnx.clone(NET)
        net["inp"].kernel.set_value(value)
        check_error(lambda net=net: adapted(net=net), "cannot adapt inp: an adapter needs a")
    net["inp"].kernel = None
    check_error(
        lambda: adapted(net=net), "cannot adapt inp: its kernel must be an nnx.Variable, got None"
    )


def test_8_bit_kernels_need_a_compute_dtype():
    kind = {"param_dtype": jnp.float8_e4m3fn, "rngs": nnx.Rngs(0)}
    net = nnx.Dict(inp=nnx.Linear(5, 4, **kind))
    check_error(
        lambda: adapted(net=net)["inp"](X), "cannot promote float32 input and float8_e4m3fn kernel"
    )
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


LINEN = lorasp_jax.LinenAdapter(nn.Dense(3), [("", METHOD)])


@pytest.mark.parametrize("variables", [{}, None, 5, {"params": 5}, {"adapters": {}}])
def test_linen_variables(variables):
    message = 'variables must be a dict whose "params" is a dict'
    check_error(lambda: LINEN.apply(variables, X), message)
    check_error(lambda: LINEN.merge(variables, X), message)
    check_error(lambda: LINEN.attach(KEY, variables, X), message)


def test_linen_adapters_of_another_width():
    variables = LINEN.init(KEY, X)
    narrow = jax.tree.map(lambda a: a[:1], variables["adapters"])
    check_error(lambda: LINEN.apply(variables | {"adapters": narrow}, X), "needs lora_a [5, 2]")


SHAPES = "holds shapes without values"


@pytest.mark.parametrize("model", [5, None, nn.Dense(3), {}])
def test_not_a_model(model, tmp_path):
    message = "must be an NNX module" if model != {} else "must be an NNX module, got dict"
    for call in (
        lambda: lorasp_jax.summary(model),
        lambda: lorasp_jax.merge(model),
        lambda: lorasp_jax.split(model),
        lambda: lorasp_jax.with_dropout(model, KEY),
        lambda: lorasp_jax.quantize(model, [("inp", "nf4")]),
        lambda: lorasp_jax.save_adapters(tmp_path, model),
        lambda: lorasp_jax.save_peft(tmp_path, model),
        lambda: lorasp_jax.load_peft(tmp_path, model),
        lambda: lorasp_jax.unmerge(model, adapted()),
        lambda: lorasp_jax.unmerge(NET, model),
        lambda: lorasp_jax.combine({"a": model}),
        lambda: lorasp_jax.choose(model, "a"),
        lambda: lorasp_jax.fuse(model, {"a": 1.0}),
        lambda: lorasp_jax.prune(model, [X]),
    ):
        check_error(call, message)


def test_abstract_models(tmp_path):
    """Abstract models can be adapted and counted, but not called."""
    model = nnx.eval_shape(adapted)
    assert lorasp_jax.summary(model)
    for call in (
        lambda: lorasp_jax.merge(model),
        lambda: lorasp_jax.quantize(model, [("head", "nf4")]),
        lambda: lorasp_jax.combine({"a": model}),
        lambda: lorasp_jax.unmerge(NET, model),
        lambda: lorasp_jax.save_adapters(tmp_path, model),
        lambda: lorasp_jax.save_peft(tmp_path, model),
    ):
        check_error(call, SHAPES)
    bare = nnx.eval_shape(lambda: nnx.clone(NET))
    check_error(
        lambda: adapted(FullFineTuning(), bare), "inp/bias has a shape but no value: call this"
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda _: lorasp_jax.summary(adapted(), 5),
            "aux must be the result of collect_aux, got 5",
        ),
        (lambda _: lorasp_jax.collect_aux(None), "variables returned by a Linen model, got None"),
        (lambda _: lorasp_jax.collect_aux({"intermediates": 5}), "got {'intermediates': 5}"),
        (lambda _: lorasp_jax.auxiliary_losses({"a": 5}), "aux must be a tree of Aux"),
        (
            lambda _: lorasp_jax.adapt(NET, [("inp", METHOD)], **RNGS, statistics=5),
            "statistics must be a mapping from calibration.input_moments, got 5",
        ),
        (
            lambda _: lorasp_jax.adapt(
                NET, [("inp", METHOD)], **RNGS, statistics={"inp": jnp.full((5, 5), jnp.nan)}
            ),
            "statistics of inp must be finite, of shape [..., I, I], got float32 [5, 5]",
        ),
        (
            lambda _: lorasp_jax.with_dropout(NET, 5),
            "key must be a PRNG key such as jax.random.key(0)",
        ),
        (lambda _: lorasp_jax.save_adapters(5, adapted()), "folder must be a str or path, got 5"),
        (
            lambda _: lorasp_jax.save_adapters("gs://x/y", adapted()),
            "gs://x/y is a URL; adapters must",
        ),
        (
            lambda _: lorasp_jax.save_peft(Path("gs://x/y"), adapted()),
            "gs:/x/y is a URL; adapters must",
        ),
        (lambda _: lorasp_jax.load_adapters("gs://x/y", NET), "gs://x/y is a URL; adapters must"),
        (lambda f: lorasp_jax.load_adapters(f / LONG, NET), "must have at most 255 bytes, got '"),
        (lambda f: lorasp_jax.load_peft(f / LONG, NET), "must have at most 255 bytes"),
        (
            lambda f: lorasp_jax.save_adapters(f, adapted(), base=5),
            "base must be the base model's name (str)",
        ),
        (
            lambda f: lorasp_jax.save_adapters(f, adapted(), metadata={"a": float("nan")}),
            "metadata is not JSON-serializable: Out of range",
        ),
        (
            lambda f: lorasp_jax.save_adapters(f, adapted(), metadata={1: 2}),
            "metadata must be a dict with str keys, got {1: 2}",
        ),
        (
            lambda f: lorasp_jax.save_peft(f, adapted(), names=5),
            "names must be callable (path, index) -> str",
        ),
        (
            lambda f: lorasp_jax.save_peft(f, adapted(), names=lambda *_: None),
            "names('inp', ()) must return a non-empty str, got None",
        ),
        (
            lambda f: lorasp_jax.save_peft(
                f, lorasp_jax.adapt(NET, [(".*", METHOD)], **RNGS), names=lambda *_: "one"
            ),
            "names returns 'one' for both ('head', ()) and ('inp', ())",
        ),
        (
            lambda f: lorasp_jax.save_peft(f, adapted(), base=5),
            "base must be the base model's name (str)",
        ),
        (
            lambda _: lorasp_jax.fuse(lorasp_jax.combine({"a": adapted()}), 5),
            "weights must be a non-empty",
        ),
        (
            lambda _: lorasp_jax.fuse(lorasp_jax.combine({"a": adapted()}), {"a": 1.0}, rank="x"),
            "rank must be an integer from 1",
        ),
        (lambda _: lorasp_jax.combine({5: adapted()}), "must be a non-empty mapping from name"),
    ],
)
def test_other_arguments(call, message, tmp_path):
    check_error(lambda: call(tmp_path / "new"), message)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    "call",
    [
        lambda: lorasp_jax.adapt(NET, [(LONG, METHOD)], **RNGS),
        lambda: lorasp_jax.adapt(NET, [("(" + LONG, METHOD)], **RNGS),
        lambda: lorasp_jax.adapt(NET, [("inp", LONG)], **RNGS),
        lambda: lorasp_jax.adapt(NET, LONG, **RNGS),
        lambda: lorasp_jax.quantize(NET, [(LONG, "nf4")]),
        lambda: peft.create(LONG),
        lambda: LoRA(**{LONG: 1}),
        lambda: LoRA(initialization=LONG),
        lambda: lorasp_jax.choose(lorasp_jax.combine({"a": adapted()}), LONG),
        lambda: lorasp_jax.summary(adapted(), {LONG: 5}),
    ],
)
def test_long_values_are_truncated(call):
    check_error(call, "qqq")
