"""Simulate with MuJoCo MJX; only this folder depends on its implementations, JAX and Warp."""
