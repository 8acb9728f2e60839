"""How XLA compiles a training step."""

import jax

from envs.compilation import fast_cpu

_ON_GPU: dict[str, str | bool] = {
    "xla_gpu_enable_triton_gemm": False,
    "xla_gpu_autotune_level": "3",
}
"""Leave all matmuls to cuBLAS and cuDNN, and do not check the results of the algorithms it tries.

By default, XLA also compiles and times dozens of Triton kernels per matmul. On an H100, SmolVLA's
step takes the same 180 ms without them, that of the small π0 11.4 ms instead of 11.9; compiling
takes 210 instead of 656 seconds of CPU time, and 85 instead of 333.
"""


def step_options() -> dict[str, str | bool] | None:
    """Return the compiler options of a program that trains."""
    if jax.default_backend() == "gpu":
        return dict(_ON_GPU)
    return fast_cpu.without_simulation()
