"""Private JAX APIs that this package needs; no other module of it imports any.

They exist in JAX 0.10.2, 0.11.2 and 0.12.0.1.
"""

from typing import Any

from jax._src import clusters, distributed
from jax.interpreters import partial_eval

find_processes = clusters.ClusterEnv.auto_detect_unset_distributed_params
"""Detect the coordinator address, number of processes and process index in Slurm, Open MPI,
Kubernetes or a TPU pod. `jax.distributed.initialize` calls this function but does not expose its
result, needed to say what is awaited and to check the port: JAX crashes if it is in use."""

coordination: Any = distributed.global_state
"""Its `client` reads and writes the keys that all processes share; orbax gives only barriers."""

eliminate_dead_code = partial_eval.dce_jaxpr
"""Remove equations with unused results from a jaxpr; `jax.jit` does so only during compilation.
Without it, FLOP counts would include operations with unused results."""
