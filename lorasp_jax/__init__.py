"""LoRA-SP (Select-Prune, arXiv 2603.07404) for vision-language-action models in JAX.

Axis letters used in every docstring and einsum of this package:

    B batch          T tokens        S key tokens     D width
    N query heads    K kv heads      H head dim       F mlp width
    I, O dense in, out               R bank size (maximum rank)
    L layer          A action dim    C chunk length
    J joints         W parallel worlds
"""

import lazy_loader

__version__ = "0.1.0"

# Importing JAX and Flax takes a second, which would delay `lorasp-jax --help` and Ctrl-C.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
