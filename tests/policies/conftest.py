import numpy as np
import pytest

from lorasp_jax.policies import prompts


@pytest.fixture
def few_bins(monkeypatch):
    """Divide states into 16 bins, because a table is compared with all pairs of numbers."""
    monkeypatch.setattr(prompts, "STATE_BINS", 16)
    monkeypatch.setattr(prompts, "EDGES", np.linspace(-1, 1, 17)[:-1])
