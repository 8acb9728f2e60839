"""Weights in files: this project's own layout and the published ones."""
