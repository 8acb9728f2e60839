"""Judge policies in Gymnasium environments of other packages, by the environments' own success.

    python -m lorasp_jax.extras.judge runs/NAME --env MODULE:factory
    python -m lorasp_jax.extras.judge --server ws://127.0.0.1:8000 --env MODULE:factory

The second form needs neither JAX nor the policy's files, only NumPy, lazy_loader, msgpack and
websockets, so it runs where the environment's own pins rule out this project's dependencies.
"""

from lorasp_jax.extras.judge.task import GymTask

__all__ = ["GymTask"]
