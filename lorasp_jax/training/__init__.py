"""Training: setup, step, loop, checkpoints and export of a run."""

import lazy_loader

# Lazy, because `train.py --help` needs none of these modules.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
