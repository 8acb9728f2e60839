"""Weights of the auxiliary losses over a run."""

import pytest

from lorasp_jax.config import AuxiliaryConfig
from lorasp_jax.training.optim import auxiliary_weights


def test_auxiliary_weights_rise_from_zero_over_the_warm_up():
    """The task's gradient reaches the router only once U has left zero; its losses wait for it."""
    weights = auxiliary_weights(AuxiliaryConfig(spectral=0.5, balance=0.2, warmup=0.1), steps=100)
    for name, weight in (("spectral", 0.5), ("balance", 0.2), ("z", 1e-3), ("orthogonality", 0.1)):
        values = [float(weights[name](step)) for step in (0, 5, 10, 99)]
        assert values == pytest.approx([0, weight / 2, weight, weight])
