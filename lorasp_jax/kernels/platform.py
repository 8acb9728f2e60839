"""The platform that a function is traced for."""

import jax


def platform() -> str:
    """Return "cpu", "gpu" or "tpu": JAX's default, unless the abstract mesh names a device.

    A host without a GPU can thus lower a program for one. Set an `abstract_device` of platform
    "cuda" with `jax.sharding.use_abstract_mesh`. JAX retraces a function under a different mesh.
    """
    device = jax.sharding.get_abstract_mesh().abstract_device
    if device is None:
        return jax.default_backend()
    return "gpu" if device.platform in ("cuda", "rocm") else device.platform


def multiplies_float8() -> bool:
    """Return whether `platform()` is an NVIDIA GPU that multiplies float8: Ada, Hopper or later.

    An abstract device does not tell its age; a GPU is taken for such a one.
    """
    return _compute_capability() >= 8.9


def has_large_shared_memory() -> bool:
    """Return whether `platform()` is an NVIDIA GPU with 160 KiB of shared memory per block or more.

    Those are A100, H100, B200 and their relatives; others have 99 KiB (CUDA C++ Programming Guide,
    technical specifications per compute capability). An abstract GPU is taken for such a one.
    """
    return _compute_capability() in (8.0, 9.0, 10.0, 10.3)


def _compute_capability() -> float:
    """Return that of an NVIDIA GPU, Hopper's 9.0 for an abstract one, and 0 for other devices."""
    device = jax.sharding.get_abstract_mesh().abstract_device
    if device is not None:
        return 9.0 if device.platform == "cuda" else 0.0
    capability = getattr(jax.devices()[0], "compute_capability", "0")  # AMD's reads gfx942
    return float(capability) if capability.replace(".", "").isdigit() else 0.0
