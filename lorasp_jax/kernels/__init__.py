"""Numerical kernels, each with one plain XLA reference and the same results on every backend."""
