"""Simulate with MuJoCo MJX; only this folder depends on its JAX and Warp implementations."""
