"""Adapter files in this project's format and in that of Hugging Face PEFT."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, ["hugging_face"])
