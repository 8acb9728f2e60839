"""The kind of device that a function is traced for."""

import jax


def platform() -> str:
    """ "cpu", "gpu" or "tpu": the abstract mesh's device where one is in use, else JAX's default.

    So a CPU lowers what an NVIDIA GPU is to run, under `jax.sharding.use_abstract_mesh` with a mesh
    whose `abstract_device` is of platform "cuda". JAX traces a function anew under another mesh.
    """
    device = jax.sharding.get_abstract_mesh().abstract_device
    if device is None:
        return jax.default_backend()
    return "gpu" if device.platform in ("cuda", "rocm") else device.platform
