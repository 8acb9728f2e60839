"""Training: setup, step, loop, checkpoints and export of a run."""

import lazy_loader

# `train.py --help` does not need them.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
