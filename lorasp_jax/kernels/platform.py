"""The platform that a function is traced for."""

import jax


def platform() -> str:
    """Return "cpu", "gpu" or "tpu": the platform of the abstract mesh's device if it has one, else
    JAX's default.

    A host without a GPU can thus lower a program for an NVIDIA GPU, under
    `jax.sharding.use_abstract_mesh` with an `abstract_device` of platform "cuda". JAX retraces a
    function under a different mesh.
    """
    device = jax.sharding.get_abstract_mesh().abstract_device
    if device is None:
        return jax.default_backend()
    return "gpu" if device.platform in ("cuda", "rocm") else device.platform
