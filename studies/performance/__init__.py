"""Measured speed and memory, beyond what docs/benchmarks.md shows."""
