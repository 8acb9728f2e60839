"""Render images of the worlds, with a ray caster in JAX or with MuJoCo Warp."""
