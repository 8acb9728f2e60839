"""Active directions by task: frequencies, box plots and overlaps with known answers."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.data.batches import Batch
from lorasp_jax.dense import Dense
from lorasp_jax.peft import Aux, LoRA, LoRASP
from studies.paper.measures import directions
from studies.paper.measures.directions import Use
from tests.studies.paper.updates import add_noise

RANK, WIDTH = 6, 4


class Model(nnx.Module):
    """A layer with a bank in each of two towers, and one without."""

    def __init__(self):
        self.vision, self.action, self.other = (
            Dense(WIDTH, WIDTH, rngs=nnx.Rngs(i)) for i in range(3)
        )

    def loss(self, key, observation, actions, action_mask):
        mask = action_mask[..., 0]
        x = actions + jax.random.normal(key, actions.shape)
        x, vision = self.vision(x, token_mask=mask, return_aux=True)
        x, action = self.action(x, token_mask=mask, return_aux=True)
        x, other = self.other(x, token_mask=mask, return_aux=True)
        return x, {"vision": {"fc1": vision}, "action": {"out": action, "other": other}}


@pytest.fixture(scope="module")
def model():
    bank = LoRASP(rank=RANK, hidden_width=4, energy_target=0.6)
    rules = [("vision|action", bank), ("other", LoRA(rank=2))]
    return add_noise(lorasp_jax.adapt(Model(), rules, rngs=nnx.Rngs(1)))


def batches(number):
    for key in jax.random.split(jax.random.key(0), number):
        mask = jax.random.bernoulli(key, 0.7, (3, 5, 1))
        yield key, Batch(None, jax.random.normal(key, (3, 5, WIDTH)), mask)


def test_counts_are_those_of_the_gate(model):
    """Counts over two batches equal those of the aux, over valid tokens only."""
    uses = directions.directions_in_use(model, batches(2))
    assert {tower: [*linears] for tower, linears in uses.items()} == {
        "vision": ["fc1"],
        "action": ["out"],
    }
    usage, ranks = np.zeros(RANK), []
    for key, batch in batches(2):
        _, aux = model.loss(key, None, batch.actions, batch.action_mask)
        usage += np.asarray(aux["vision"]["fc1"].usage)
        valid = np.asarray(batch.action_mask[..., 0])
        ranks += np.asarray(aux["vision"]["fc1"].active_rank)[valid].tolist()
    use = uses["vision"]["fc1"]
    np.testing.assert_array_equal(use.usage, [usage])
    np.testing.assert_array_equal(use.ranks, [np.bincount(np.int64(ranks), minlength=RANK + 1)])
    np.testing.assert_allclose(use.frequency, [usage / len(ranks)])
    assert use.usage.sum() == sum(ranks)
    assert directions.rank_boxes(uses)["vision"]["fc1"] == [
        np.quantile(ranks, directions.QUARTILES, method="inverted_cdf").tolist()
    ]


def test_counts_of_a_stack():
    """The layers of a stack keep their own counts."""
    rank = jnp.array(
        [[[1.0, 2.0], [0.0, 2.0]], [[2.0, 2.0], [2.0, 2.0]]]
    )  # layers, windows, tokens
    mask = jnp.array([[True, True], [True, False]])
    usage = jnp.array([[2.0, 1.0], [3.0, 3.0]])
    counted, ranks = directions._layer_counts(Aux(rank, token_mask=mask, usage=usage))
    np.testing.assert_array_equal(counted, usage)
    np.testing.assert_array_equal(ranks, [[1, 1, 1], [0, 0, 3]])


@pytest.mark.parametrize("seed", range(5))
def test_five_numbers_are_quantiles_that_occur(seed):
    values = np.random.default_rng(seed).integers(2, 9, 3 + 17 * seed)
    expected = np.quantile(values, directions.QUARTILES, method="inverted_cdf")
    assert directions._five_numbers(np.bincount(values, minlength=12)) == expected.tolist()


def uses(*frequencies, tokens=100):
    """Use of one stack, from the frequencies of its layers."""
    frequency = np.array(frequencies)
    ranks = np.zeros((len(frequency), frequency.shape[1] + 1), np.int64)
    ranks[:, 0] = tokens  # only the number of tokens counts here
    return {"vision": {"fc1": Use(np.round(frequency * tokens), ranks)}}


@pytest.mark.parametrize(
    ("a", "b", "index"),
    [
        ([1, 0.5, 0, 0], [1, 0.5, 0, 0], 1),
        ([1, 1, 0, 0], [0, 0, 1, 1], 0),
        ([1, 1, 0, 0], [0, 1, 1, 0], 1 / 3),  # for sets, intersection over union
        ([0.5, 0.2, 0, 1], [0.25, 0.4, 0, 1], (0.25 + 0.2 + 1) / (0.5 + 0.4 + 1)),
    ],
)
def test_overlap_is_the_weighted_jaccard_index(a, b, index):
    found = directions.overlap(uses(a), uses(b))
    assert found["vision"][0] == pytest.approx(index)
    assert found["all"] == found["vision"]


def test_overlap_by_chance_averages_over_all_permutations():
    """Directions are permuted in each layer; numerator and denominator are averaged."""
    a, b = [[0.9, 0.4, 0.1], [0.0, 0.2, 1.0]], [[0.3, 0.7, 0.0], [0.5, 0.5, 0.1]]
    least, most = [], []
    for first, second in itertools.product(itertools.permutations(range(3)), repeat=2):
        x, y = np.array(a), np.array([np.array(b[0])[[*first]], np.array(b[1])[[*second]]])
        least, most = [*least, np.minimum(x, y).sum()], [*most, np.maximum(x, y).sum()]
    _, chance = directions.overlap(uses(*a), uses(*b))["vision"]
    assert chance == pytest.approx(np.mean(least) / np.mean(most))


def test_directions_without_identity_overlap_as_by_chance():
    """All directions alike: tasks cannot differ, and chance expects the same."""
    index, chance = directions.overlap(uses([0.4] * 4), uses([0.4] * 4))["vision"]
    assert index == pytest.approx(chance) == pytest.approx(1)


def test_towers_are_pooled_by_frequency():
    a, b = uses([1, 0]), uses([1, 1])
    a["action"], b["action"] = uses([1, 1])["vision"], uses([1, 1])["vision"]
    found = directions.overlap(a, b)
    assert [found[tower][0] for tower in ("vision", "action", "all")] == [0.5, 1.0, 0.75]


def test_no_active_direction_at_all():
    assert directions.overlap(uses([0, 0]), uses([0, 0]))["all"] == (0, 0)


def test_counts_of_data_sets_add_up():
    total = directions.merged([uses([1, 0]), uses([0.5, 0.5]), uses([0, 1])])["vision"]["fc1"]
    np.testing.assert_allclose(total.frequency, [[0.5, 0.5]])
