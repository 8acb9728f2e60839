"""Spectral ranks of updates with known singular values."""

import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.peft import FullFineTuning, LoRA, LoRASP
from studies.paper.measures import layers, spectra
from tests.adapters.test_adaptation import LAYERS, WIDTH, Net
from tests.studies.paper.updates import add_noise, matrix, set_kernel


@pytest.fixture(scope="module")
def base():
    return Net(nnx.Rngs(0))


def adapted(base, method):
    return lorasp_jax.adapt(base, [(".*", method)], rngs=nnx.Rngs(1))


@pytest.mark.parametrize(
    ("energies", "rank"),
    [([100], 1), ([99.1, 0.9], 1), ([98.9, 1.1], 2), ([50, 49, 1], 2), ([25, 25, 25, 25], 4)],
)
def test_the_smallest_rank_that_holds_the_energy(energies, rank):
    assert spectra.energy_rank(np.array(energies), 0.99) == rank


def test_shares_by_layer_of_a_stack(base):
    """Updates of the blocks have one, two and four equal singular values."""
    model = adapted(base, FullFineTuning())
    updates = [matrix((WIDTH, WIDTH), [0.1] * n, seed=n) for n in (1, 2, 4)]
    set_kernel(model.blocks, base.blocks.kernel.get_value() + np.stack(updates))
    found = spectra.spectral_rank(model, base)
    assert found["blocks"] == [1 / 4, 2 / 4, 4 / 4]
    assert found.keys() == {"inp", "blocks", "heads/0", "heads/1"}


def test_any_shape_has_the_rank_of_its_singular_values():
    """Against NumPy's SVD, for tall and wide updates with a decaying spectrum."""
    for seed, shape in enumerate([(40, 12), (12, 40), (25, 25)]):
        update = matrix(shape, 0.8 ** np.arange(min(shape)), seed).astype(np.float64)
        values = np.linalg.svd(update, compute_uv=False)
        share = np.cumsum(values**2) / np.sum(values**2)
        expected = (int(np.argmax(share >= 0.99)) + 1) / min(shape)
        assert spectra._share(update, np.ones(shape)) == expected


def test_layers_that_did_not_learn_have_no_rank(base):
    """Weight decay alone shrinks a weight, up to rounding, and has the spectrum of the weight."""
    model = adapted(base, FullFineTuning())
    kernel = np.asarray(base.blocks.kernel.get_value())
    for _ in range(300):
        kernel = kernel + np.float32(-1e-7) * kernel
    kernel[2] += 0.01 * matrix((WIDTH, WIDTH), [1.0], seed=0)
    set_kernel(model.blocks, kernel)
    found = spectra.spectral_rank(model, base)
    assert found["blocks"] == [None, None, 1 / 4]
    assert found["inp"] == [None]


def test_a_weight_that_was_zero_can_learn(base):
    model = adapted(base, FullFineTuning())
    zero = nnx.clone(base)
    set_kernel(zero.blocks, np.zeros((LAYERS, WIDTH, WIDTH), np.float32))
    assert spectra.spectral_rank(model, zero)["blocks"] == [
        spectra.energy_rank(np.linalg.svd(kernel, compute_uv=False) ** 2, 0.99) / WIDTH
        for kernel in np.asarray(base.blocks.kernel.get_value())
    ]


@pytest.mark.slow
def test_adapters_are_merged(base):
    shares = spectra.spectral_rank(add_noise(adapted(base, LoRA(rank=1))), base)
    assert shares["blocks"] == [1 / 4] * LAYERS
    assert shares["heads/0"] == [1 / 2]
    with pytest.raises(ValueError, match="cannot be merged"):
        spectra.spectral_rank(adapted(base, LoRASP(rank=4)), base)


def test_towers():
    paths = ["vision/blocks/fc1", "language/norm/dense", "action/blocks/q_proj", "state_proj"]
    values = dict(zip(paths, range(4), strict=True))
    assert layers.by_tower(values) == {
        "vision": {"fc1": 0},
        "language": {"norm/dense": 1},
        "action": {"q_proj": 2, "state_proj": 3},
    }
