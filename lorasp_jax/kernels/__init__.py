"""Numerical kernels. Each has a plain XLA reference and gives the same results on every backend."""
