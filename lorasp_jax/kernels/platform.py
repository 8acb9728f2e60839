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
