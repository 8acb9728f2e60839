"""Numerical kernels. Each has an XLA reference and gives the same results on every backend."""
