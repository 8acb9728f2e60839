"""Episodes in memory and on disk."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, ["rlds"])
