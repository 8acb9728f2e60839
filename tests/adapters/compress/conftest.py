import jax
import pytest

from tests.adapters.compress.lora_sp_models import TOKENS


@pytest.fixture(scope="module")
def batches():
    """Calibration batches for `lora_sp_model`."""
    return [jax.random.normal(jax.random.key(i), (TOKENS, 5)) for i in range(2)]
