"""Test mean active ranks of rows."""

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.extras.serving import ranks
from lorasp_jax.peft import Aux

RANK = jnp.arange(24.0).reshape(2, 3, 4)  # of two layers, three rows and four tokens
MASK = jnp.arange(4) < jnp.array([[4], [2], [1]])


def gated(rank, mask=MASK):
    return Aux(active_rank=rank, token_mask=mask, kept_energy=jnp.ones(rank.shape))


def test_the_mean_is_over_valid_tokens_then_over_layers_and_steps():
    fixed = Aux(active_rank=RANK + 100, token_mask=MASK)  # has no gate
    once = ranks.summed({"language": {"q_proj": gated(RANK), "k_proj": fixed}}, 3)
    np.testing.assert_allclose(ranks.mean(once, None), [7.5, 10.5, 14])
    steps = [ranks.summed({"action": {"q_proj": gated(RANK[0] + step)}}, 3) for step in (0, 3)]
    steps = jax.tree.map(lambda *each: jnp.stack(each), *steps)
    np.testing.assert_allclose(ranks.mean(None, steps), [3, 6, 9.5])
    np.testing.assert_allclose(ranks.mean(once, steps), [6, 9, 12.5])
    assert ranks.summed({"language": {"k_proj": fixed}}, 3) is ranks.mean(None, None) is None


def test_images_of_a_row_are_its_own():
    rank, mask = [[1.0, 2], [3, 9], [5, 5], [7, 7]], [[True, True], [True, False]] * 2
    images = gated(jnp.array(rank), jnp.array(mask))
    found = ranks.mean(ranks.summed({"vision": {"fc1": images}}, 2), None)
    np.testing.assert_allclose(found, [2, 17 / 3], rtol=1e-6)
