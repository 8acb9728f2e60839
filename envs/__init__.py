"""Batched manipulation environments in MuJoCo MJX with cameras and scripted experts.

import envs
env = envs.make("press", robot="piper", num_envs=64, image_size=64)
episodes = envs.collect("press", robot="panda", num_episodes=512, key=jax.random.key(0))
"""

import lazy_loader

import envs.interop.ids
import lorasp_jax.base.fast_cpu
import lorasp_jax.base.lapack

lorasp_jax.base.fast_cpu.set_flag()  # before anything starts JAX
lorasp_jax.base.lapack.split_calls()

# Lazy, because importing MJX would delay `--help` by seconds.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

envs.interop.ids.register()
