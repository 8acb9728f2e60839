"""Schedules of the auxiliary weights."""

import pytest

from lorasp_jax.config import AuxiliaryConfig
from lorasp_jax.training.optim import auxiliary_weights


def test_auxiliary_weights_rise_from_zero_over_the_warm_up():
    """The task loss reaches the router only once U is non-zero; router losses wait for that."""
    weights = auxiliary_weights(AuxiliaryConfig(spectral=0.5, balance=0.2, warmup=0.1), steps=100)
    for name, weight in (("spectral", 0.5), ("balance", 0.2), ("z", 1e-3), ("orthogonality", 0.1)):
        values = [float(weights[name](step)) for step in (0, 5, 10, 99)]
        assert values == pytest.approx([0, weight / 2, weight, weight])
