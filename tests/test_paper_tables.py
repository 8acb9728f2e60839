"""Test that the paper's parameter columns (arXiv 2603.07404v1) are reproduced to every digit."""

import math

import pytest

from benchmarks import paper_tables
from lorasp_jax.peft import LoRA, LoRAMoE, LoRASP

TABLE_I = {
    "LoRA (r=128)": ("9.1", "17.0"),
    "LoRA-MoE (top-1)": ("9.2", "17.2"),
    "LoRA-MoE (weighted sum)": ("9.2", "17.2"),
    "AdaLoRA": ("9.1", "17.0"),
    "Full FT": ("100.0", "100.0"),
    "LoRA-SP": ("9.2", "17.1"),
}
TABLE_II = {
    "LoRA (r=8)": ("0.6", "1.3"),
    "LoRA (r=16)": ("1.2", "2.5"),
    "LoRA (r=32)": ("2.4", "4.9"),
    "LoRA (r=64)": ("4.8", "9.3"),
    "LoRA (r=128)": ("9.1", "17.0"),
    "Full FT": ("100.0", "100.0"),
    "LoRA-SP": ("9.2", "17.1"),
}


@pytest.mark.parametrize(("name", "printed"), [("I", TABLE_I), ("II", TABLE_II)])
def test_parameter_column_matches_the_paper(name, printed):
    expected = {
        (backbone, strategy): values[i]
        for i, backbone in enumerate(("π0", "SmolVLA"))
        for strategy, values in printed.items()
    }
    assert paper_tables.parameter_column(name) == expected


@pytest.mark.parametrize(
    ("backbone", "layers", "sum_in_out", "sum_in", "total"),
    [
        ("π0", 422, 2_731_200, 998_960, 3_501_372_176),
        ("SmolVLA", 303, 720_336, 331_584, 450_046_176),
    ],
)
def test_linear_layers(backbone, layers, sum_in_out, sum_in, total):
    """Check the number of layers, their sums of I + O and of I, and the backbone's parameters."""
    config = paper_tables.BACKBONES[backbone]
    shapes, backbone_total = paper_tables.linear_layers(config)
    stacks = [(math.prod(stack), d_in, d_out) for *stack, d_in, d_out in shapes.values()]
    assert backbone_total == total
    assert sum(n for n, _, _ in stacks) == layers
    assert sum(n * (d_in + d_out) for n, d_in, d_out in stacks) == sum_in_out
    assert sum(n * d_in for n, d_in, _ in stacks) == sum_in
    assert paper_tables.count(config, LoRA(rank=16)) == (16 * sum_in_out, total + 16 * sum_in_out)


MORE_DIGITS = [
    *zip(
        (LoRA(rank=rank) for rank in (8, 16, 32, 64, 128)),
        (0.620, 1.233, 2.435, 4.755, 9.078),
        (1.264, 2.497, 4.872, 9.292, 17.004),
        strict=True,
    ),
    (LoRAMoE(), 9.172, 17.206),
    (LoRASP.paper(), 9.152, 17.109),
]


@pytest.mark.parametrize(("method", "pi0", "smolvla"), MORE_DIGITS)
def test_counts_to_three_decimals(method, pi0, smolvla):
    for config, percent in zip(paper_tables.BACKBONES.values(), (pi0, smolvla), strict=True):
        trainable, total = paper_tables.count(config, method)
        assert 100 * trainable / total == pytest.approx(percent, abs=6e-4)


@pytest.mark.parametrize(
    ("router", "printed"),
    [
        # Width h with biases on all linear layers, then the released code's linear router.
        *((lambda d_in, h=h: h * (d_in + 128) + h + 128, p) for h, p in ((4, 17.2), (8, 17.5))),
        (lambda d_in: 128 * d_in, 23.0),
    ],
    ids=["4", "8", "release"],
)
def test_other_routers_do_not_give_the_published_17_1(router, printed):
    shapes, total = paper_tables.linear_layers(paper_tables.BACKBONES["SmolVLA"])
    adapters = sum(
        math.prod(stack) * (128 * (d_in + d_out) + router(d_in))
        for *stack, d_in, d_out in shapes.values()
    )
    assert round(100 * adapters / (total + adapters), 1) == printed
