"""How XLA compiles a training step."""

import jax

from lorasp_jax.base import fast_cpu

_ON_GPU: dict[str, str | bool] = {
    "xla_gpu_enable_triton_gemm": False,
    "xla_gpu_autotune_level": "3",
}
"""Leave all matmuls to cuBLAS and cuDNN, and do not check the results of the algorithms it tries.

By default, XLA also compiles and times dozens of Triton kernels per matmul. On an H100, SmolVLA's
step takes the same 180 ms without them, that of the small π0 11.4 ms instead of 11.9; compiling
takes 210 instead of 656 seconds of CPU time, and 85 instead of 333.
"""


def step_options(devices: int) -> dict[str, str | bool] | None:
    """Return the compiler options of a program that trains on this many devices.

    On one GPU, XLA's latency-hiding scheduler has no transfers between devices to hide. In a loop
    of steps, it moves what the backward pass recomputes to its beginning, which keeps all of it in
    memory at once: pi0 with `--model.remat narrow` and a batch of 20 took 70 GiB on an H200.
    Without the scheduler, it takes 26 GiB.
    """
    if jax.default_backend() != "gpu":
        return fast_cpu.without_simulation()
    return _ON_GPU if devices > 1 else _ON_GPU | {"xla_gpu_enable_latency_hiding_scheduler": False}
