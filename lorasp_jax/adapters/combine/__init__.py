"""Combine several adapters in one model."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, ["named"])
