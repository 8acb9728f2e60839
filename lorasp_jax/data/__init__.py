"""Datasets and training batches."""

import lazy_loader

# `--help` should load neither Grain nor PyArrow.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
