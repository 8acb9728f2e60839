"""LoRA-SP (Select-Prune, arXiv 2603.07404) for vision-language-action models in JAX.

Axis letters used in every docstring and einsum of this package:

    B batch          T tokens        S key tokens     D width
    N query heads    K kv heads      H head dim       F mlp width
    I, O dense in, out               R bank size (maximum rank)
    L layer          A action dim    C chunk length
    J joints         W parallel worlds
"""

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lorasp_jax import dense, peft
    from lorasp_jax.adapters.adaptation import adapt, count, merge, penalties, split, with_dropout
    from lorasp_jax.adapters.combine import named
    from lorasp_jax.adapters.combine.fusion import fuse, unmerge
    from lorasp_jax.adapters.combine.named import choose, combine, extract, swap
    from lorasp_jax.adapters.compress.calibration import input_moments
    from lorasp_jax.adapters.compress.distillation import distill
    from lorasp_jax.adapters.compress.pruning import prune
    from lorasp_jax.adapters.compress.quantization import quantize
    from lorasp_jax.adapters.io import hugging_face
    from lorasp_jax.adapters.io.hugging_face import load_peft, save_peft
    from lorasp_jax.adapters.io.native import load_adapters, save_adapters
    from lorasp_jax.adapters.linen import LinenAdapter
    from lorasp_jax.adapters.summary import collect_aux, summary
    from lorasp_jax.peft import (
        AdaLoRA,
        DoRA,
        FullFineTuning,
        LoRA,
        LoRAMoE,
        LoRASP,
        LoRASPRelease,
    )
    from lorasp_jax.peft._aux import auxiliary_losses

__version__ = "0.1.0"

__all__ = [
    "AdaLoRA",
    "DoRA",
    "FullFineTuning",
    "LinenAdapter",
    "LoRA",
    "LoRAMoE",
    "LoRASP",
    "LoRASPRelease",
    "adapt",
    "auxiliary_losses",
    "choose",
    "collect_aux",
    "combine",
    "count",
    "dense",
    "distill",
    "extract",
    "fuse",
    "hugging_face",
    "input_moments",
    "load_adapters",
    "load_peft",
    "merge",
    "named",
    "peft",
    "penalties",
    "prune",
    "quantize",
    "save_adapters",
    "save_peft",
    "split",
    "summary",
    "swap",
    "unmerge",
    "with_dropout",
]

_MODULES = {
    "adapters.adaptation": "adapt count merge penalties split with_dropout",
    "adapters.combine.fusion": "fuse unmerge",
    "adapters.combine.named": "choose combine extract swap",
    "adapters.compress.calibration": "input_moments",
    "adapters.compress.distillation": "distill",
    "adapters.compress.pruning": "prune",
    "adapters.compress.quantization": "quantize",
    "adapters.io.hugging_face": "load_peft save_peft",
    "adapters.io.native": "load_adapters save_adapters",
    "adapters.linen": "LinenAdapter",
    "adapters.summary": "collect_aux summary",
    "peft": "AdaLoRA DoRA FullFineTuning LoRA LoRAMoE LoRASP LoRASPRelease",
    "peft._aux": "auxiliary_losses",
}
_SUBMODULES = {"named": "adapters.combine.named", "hugging_face": "adapters.io.hugging_face"}

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Import public names and submodules on first access.

        Importing JAX and Flax takes a second, which would delay `lorasp-jax --help` and Ctrl-C.
        """
        for module, names in _MODULES.items():
            if name in names.split():
                return getattr(importlib.import_module(f"lorasp_jax.{module}"), name)
        module = f"lorasp_jax.{_SUBMODULES.get(name, name)}"
        if importlib.util.find_spec(module) is None:
            raise AttributeError(f"module 'lorasp_jax' has no attribute {name!r}")
        return importlib.import_module(module)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
