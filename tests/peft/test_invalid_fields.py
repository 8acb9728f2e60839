"""Test that an invalid field of a method raises a one-sentence error that says what is valid."""

import re

import jax
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.peft import AdaLoRA, LoRA, LoRAMoE, LoRASP, LoRASPRelease

NET = nnx.Dict(inp=nnx.Linear(5, 4, rngs=nnx.Rngs(0)))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"r": 8}, "lora has no field 'r' (did you mean 'rank'?); valid fields are rank, alpha"),
        ({"lora_alpha": 8}, "did you mean 'alpha'?"),
        ({"rank": "8"}, "rank must be int, got '8'"),
        ({"rank": True}, "rank must be int, got True"),
        ({"rank": 0}, "rank must be at least 1, got 0"),
        ({"rank": 1.5}, "rank must be int, got 1.5"),
        ({"rank": 10**12}, "rank must be at most 1048576"),
        ({"rank": -(10**12)}, "rank must be at least -1048576"),
        ({"alpha": float("nan")}, "alpha must be a finite number or None, got nan"),
        ({"alpha": 1e308}, "alpha must be a finite number or None, got 1e+308"),
        ({"alpha": 1e35}, "|alpha| must be between 1e-30 and 1e+30, got 1e+35"),
        ({"alpha": 0}, "|alpha| must be between 1e-30 and 1e+30, got 0"),
        (
            {"alpha": -1.0, "initialization": "pissa"},
            "alpha must be positive for 'pissa', got -1.0",
        ),
        ({"dropout": 1.0}, "dropout must be in [0, 1), got 1.0"),
        ({"dropout": -0.1}, "dropout must be in [0, 1), got -0.1"),
        ({"dropout": "0.1"}, "dropout must be a finite number, got '0.1'"),
        ({"initialization": ["eva"]}, "initialization must be one of 'kaiming'"),
    ],
)
def test_fields_of_lora(fields, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        LoRA(**fields)


def test_too_many_values():
    with pytest.raises(ValueError, match=r"lora takes at most 6 values \(rank, .* ranks\), got 7"):
        LoRA(1, 2.0, False, "kaiming", 0.1, (), 3)  # pyright: ignore[reportCallIssue]


@pytest.mark.parametrize(
    ("method", "fields", "message"),
    [
        (LoRASP, {"energy_target": 0.0}, r"energy_target must lie in \(0, 1\], got 0.0"),
        (LoRASP, {"energy_target": 1.5}, r"energy_target must lie in \(0, 1\], got 1.5"),
        (LoRASP, {"rank": 0}, "rank must be at least 1, got 0"),
        (LoRASP, {"hidden_width": 0}, "hidden_width must be at least 1, got 0"),
        (LoRASP, {"router": "relu"}, "router must be one of 'gelu', .*, 'softmax', got 'relu'"),
        (LoRASPRelease, {"router": "gelu"}, "lora_sp_release has no field 'router'"),
        (LoRAMoE, {"experts": 0}, "experts and rank must be at least 1, got 0, 32"),
        (LoRAMoE, {"rank": 0}, "experts and rank must be at least 1, got 4, 0"),
        (LoRAMoE, {"routing": "top2"}, "routing must be one of 'weighted', 'top1', got 'top2'"),
        (LoRAMoE, {"gate_gradient": "soft"}, "must be one of 'hard', 'switch', got 'soft'"),
        (LoRAMoE, {"gate_gradient": "switch"}, "'switch' needs routing 'top1', got 'weighted'"),
        (AdaLoRA, {"rank": 6, "target_rank": 7}, "target_rank from 1 to rank, got"),
        (AdaLoRA, {"target_rank": 0}, "target_rank from 1 to rank, got"),
        (AdaLoRA, {"interval": 0}, "interval=0"),
        (AdaLoRA, {"warmup": 0.6, "final": 0.4}, "sum to less than 1, got 0.6 and 0.4"),
        (AdaLoRA, {"final": -0.1}, "non-negative .* got 0.1 and -0.1"),
    ],
)
def test_values_out_of_range(method, fields, message):
    with pytest.raises(ValueError, match=message):
        method(**fields)


BAD = ["x", None, True, -1, 10**30, 1e308, float("nan"), float("inf"), [], {}, (), object]
FIELDS = [
    (cls, name) for cls in (LoRA, LoRASP, LoRAMoE, AdaLoRA) for name in cls.__dataclass_fields__
]


@pytest.mark.parametrize(("cls", "field"), FIELDS)
def test_every_field_of_every_method(cls, field):
    """A wrong value raises an error that names the field, or the method works."""
    for value in BAD:
        if (message := error_message(cls, field, value)) is None:
            assert value in (None, True, -1, ())
        else:
            assert "\n" not in message
            assert field in message or repr(value) in message


def error_message(cls, field, value):
    """Return the error message, or None if the method can create its parameters."""
    try:
        method = cls(**{field: value})
    except ValueError as error:
        return str(error)
    assert jax.eval_shape(lambda: method.init_params(jax.random.key(0), 256, 256))
    return None


@pytest.mark.parametrize("initialization", ["pissa", "olora"])
def test_rank_larger_than_a_split_kernel(initialization):
    method = LoRA(rank=128, initialization=initialization)
    with pytest.raises(
        ValueError, match=r"cannot adapt inp: .* got rank 128 and a kernel \[5, 4\]"
    ):
        lorasp_jax.adapt(NET, [("inp", method)], rngs=nnx.Rngs(0))
