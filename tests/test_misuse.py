"""What a first-time user writes by mistake: one sentence that says what is valid."""

import re

import flax.linen as nn
import jax
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax import peft
from lorasp_jax.peft import AdaLoRA, LoRA, LoRAMoE, LoRASP

METHOD = LoRA(rank=2)
NET = nnx.Dict(inp=nnx.Linear(5, 4, rngs=nnx.Rngs(0)), head=nnx.Linear(4, 2, rngs=nnx.Rngs(0)))


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ({"inp": METHOD}, "got a dict: give list(rules.items())"),
        (("inp", METHOD), "one rule alone is [(pattern, ...)]"),
        ("inp", "at least one, got 'inp'"),
        ([], "at least one, got none"),
        (None, "at least one, got None"),
        ([("inp",)], "got ('inp',) among them"),
        ([(3, None)], "got (3, None) among them"),
        ([("inp", LoRA)], "rule 'inp' has the class LoRA: write LoRA()"),
        ([("inp", "lora")], "rule 'inp' has 'lora' where method or None belongs"),
        ([("(", METHOD)], "rule '(' is no regular expression"),
        ([("a{99999999999}", METHOD)], "is no regular expression: the repetition number"),
    ],
)
def test_rules(rules, message):
    """Of NNX, Linen and quantisation alike."""
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
    with pytest.raises(ValueError, match=re.escape(f"key) with params, got {given}.")):
        lorasp_jax.adapt(NET, [("inp", METHOD)], rngs=rngs)


def test_models_of_another_library():
    with pytest.raises(ValueError, match="got Dense; see LinenAdapter for Linen's"):
        lorasp_jax.adapt(nn.Dense(3), [("inp", METHOD)], rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="must be an NNX module, got dict"):
        lorasp_jax.adapt({"inp": NET.inp}, [("inp", METHOD)], rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="must be a Linen module, got Dict; `adapt` takes NNX"):
        lorasp_jax.LinenAdapter(NET, [("inp", METHOD)])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"r": 8}, "lora has no field 'r' (did you mean 'rank'?); valid are rank, alpha"),
        ({"lora_alpha": 8}, "did you mean 'alpha'?"),
        ({"rank": "8"}, "rank must be int, got '8'"),
        ({"rank": True}, "rank must be int, got True"),
        ({"rank": 1.5}, "rank must be int, got 1.5"),
        ({"rank": 10**12}, "rank must be at most 1048576"),
        ({"alpha": float("nan")}, "alpha must be a finite number or None, got nan"),
        ({"alpha": 1e308}, "alpha must be a finite number or None, got 1e+308"),
        ({"alpha": 1e35}, "alpha must not be 0 nor beyond 1e+30"),
        ({"alpha": 0}, "alpha must not be 0"),
        ({"alpha": -1.0, "initialization": "pissa"}, "alpha -1.0 is negative"),
        ({"dropout": 1.0}, "dropout must be at least 0 and less than 1, got 1.0"),
        ({"dropout": -0.1}, "dropout must be at least 0"),
        ({"dropout": "0.1"}, "dropout must be a finite number, got '0.1'"),
        ({"initialization": ["eva"]}, "initialization must be one of 'kaiming'"),
    ],
)
def test_fields_of_lora(fields, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        LoRA(**fields)


def test_more_values_than_fields():
    with pytest.raises(ValueError, match="lora has 5 fields, not 6: rank, alpha"):
        LoRA(1, 2.0, False, "kaiming", 0.1, 3)  # pyright: ignore[reportCallIssue]


BAD = ["x", None, True, -1, 10**30, 1e308, float("nan"), float("inf"), [], {}, (), object]
FIELDS = [
    (cls, name) for cls in (LoRA, LoRASP, LoRAMoE, AdaLoRA) for name in cls.__dataclass_fields__
]


@pytest.mark.parametrize(("cls", "field"), FIELDS)
def test_every_field_of_every_method(cls, field):
    """One sentence that names the field, or a method that makes its parameters."""
    for value in BAD:
        if (refusal := refused(cls, field, value)) is None:
            assert value in (None, True, -1)
        else:
            assert "\n" not in refusal
            assert field in refusal or repr(value) in refusal


def refused(cls, field, value):
    """The sentence, or None where the method can make its parameters."""
    try:
        method = cls(**{field: value})
    except ValueError as error:
        return str(error)
    assert jax.eval_shape(lambda: method.init_params(jax.random.key(0), 256, 256))
    return None


@pytest.mark.parametrize("initialization", ["pissa", "olora"])
def test_a_rank_beyond_the_kernel_that_is_split(initialization):
    method = LoRA(rank=128, initialization=initialization)
    with pytest.raises(
        ValueError, match=r"cannot adapt inp: .* got rank 128 and a kernel \[5, 4\]"
    ):
        lorasp_jax.adapt(NET, [("inp", method)], rngs=nnx.Rngs(0))


def test_methods_are_found_by_name():
    with pytest.raises(ValueError, match=r"lora_sp has no field 'energy_targt' \(did you mean"):
        peft.create("lora_sp", energy_targt=0.9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: lorasp_jax.combine([m]), "are a mapping by name"),
        (lambda m: lorasp_jax.combine({"a": m}, rank=2.5), "rank must be a whole number up to"),
        (lambda m: lorasp_jax.combine({"a": m}, rank=-1), "or None, got -1"),
        (lambda m: lorasp_jax.choose(lorasp_jax.combine({"a": m}), 3), "a choice is a name"),
        (
            lambda m: lorasp_jax.choose(lorasp_jax.combine({"a": m}), {"a": float("nan")}),
            "the weight of 'a' must be a finite number, got nan",
        ),
        (lambda m: lorasp_jax.extract(lorasp_jax.combine({"a": m}), 3), "there is no adapter 3"),
        (lambda m: lorasp_jax.prune(m, [], "x"), "tolerance must lie in [0, 1), got 'x'"),
        (lambda m: lorasp_jax.distill(m, [], 2.5), "must be a whole number, at least 1, or None"),
    ],
)
def test_several_adapters_and_smaller_ones(call, message):
    model = lorasp_jax.adapt(NET, [("inp", METHOD)], rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match=re.escape(message)):
        call(model)
