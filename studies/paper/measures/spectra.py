"""The spectral rank of fine-tuning's updates, Figure 4 of arXiv 2603.07404."""

import numpy as np
from flax import nnx

from lorasp_jax.adapters import adaptation
from studies.paper.measures import layers

ENERGY = 0.99
"""E(k) in Figure 4."""
DECAYED = 0.9
"""Cosine of an update with minus the weight from which on the update counts as weight decay alone.
Thousands of fp32 steps of decay give 0.997, training about 0."""


def spectral_rank(model: nnx.Module, base: nnx.Module) -> dict[str, list[float | None]]:
    """Return the share of singular values that hold 99 % of each dense layer's update.

    The share is k / min(I, O), with the smallest k for which E(k) = Σ_{i<=k} σ_i² / Σ σ_i² >= .99
    (eq. 3). It covers dense layers only, among them SigLIP's patch embedding, which is a dense
    layer here, but no embeddings.

    Args:
        model: fine-tuned, or with adapters that can be merged.
        base: the model before fine-tuning.

    Returns:
        Shares by layer path, one per layer of a stack. None marks a layer that did not learn: one
        that did not change, or was only decayed because the actions do not depend on it.

    Raises:
        ValueError: the update depends on the input.
    """
    before, after = layers.kernels(base), layers.kernels(adaptation.merge(model))
    return {
        path: [_share(*pair) for pair in zip(after[path] - before[path], before[path], strict=True)]
        for path in after
    }


def energy_rank(energies: np.ndarray, share: float) -> int:
    """Return the smallest k with E(k) >= `share`, for σ² `[n]` in descending order."""
    cumulative = np.cumsum(energies)
    return int(np.searchsorted(cumulative, share * cumulative[-1])) + 1


def _share(update: np.ndarray, weight: np.ndarray) -> float | None:
    """Return the share of one layer, or None if it did not learn."""
    norms = np.linalg.norm(update) * np.linalg.norm(weight)
    if not update.any() or (norms > 0 and np.vdot(update, weight) <= -DECAYED * norms):
        return None
    # σ² are the eigenvalues of the Gram matrix: twenty times faster than the SVD.
    gram = update.T @ update if update.shape[0] > update.shape[1] else update @ update.T
    energies = np.maximum(np.linalg.eigvalsh(gram)[::-1], 0.0)
    return energy_rank(energies, ENERGY) / len(energies)
