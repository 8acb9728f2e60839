"""Render images of the worlds by ray casting."""
