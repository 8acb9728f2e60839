"""What a training step reports."""

import jax.numpy as jnp
import numpy as np

from lorasp_jax.peft import Aux
from lorasp_jax.training.step import active_ranks


def test_active_ranks_by_tower_and_by_layer():
    rank = jnp.arange(12.0).reshape(2, 2, 3)  # layers, windows, tokens
    mask = jnp.array([[True, True, False], [True, False, False]])
    aux = {
        "vision": {"fc1": Aux(rank, token_mask=mask), "fc2": Aux(rank + 1)},
        "action": {"out": Aux(jnp.full((2, 3), 5.0)), "frozen": Aux()},
        "language": {"q_proj": Aux()},
    }
    found = active_ranks(aux)
    assert set(found) == {
        "active_rank/vision",
        "active_rank/vision/fc1",
        "active_rank/vision/fc2",
        "active_rank/action",
        "active_rank/action/out",
    }
    first, second = (0 + 1 + 3) / 3, (6 + 7 + 9) / 3
    np.testing.assert_allclose(found["active_rank/vision/fc1"], [first, second])
    np.testing.assert_allclose(found["active_rank/vision/fc2"], [3.5, 9.5])
    np.testing.assert_allclose(found["active_rank/vision"], ((first + second) / 2 + 6.5) / 2)
    np.testing.assert_allclose(found["active_rank/action/out"], [5.0])
