"""Simulate with MuJoCo MJX; the only folder that knows its implementations, JAX and Warp."""
