"""Closed-loop evaluation: in this project's simulation, and in Gymnasium environments of others."""

import lazy_loader

# The judge of Gymnasium environments runs where JAX is not installed.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
