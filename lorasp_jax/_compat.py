"""Private JAX and Flax APIs that this package needs; no other module imports any.

All of them exist in JAX 0.10.2, 0.11.2 and 0.12.0.1 with Flax 0.12.8 and 0.12.12. If a later
version moves one, only this file must change.
"""

from flax.core import scope
from flax.nnx.nn import dtypes
from jax._src import clusters
from jax.interpreters import partial_eval

find_processes = clusters.ClusterEnv.auto_detect_unset_distributed_params
"""Detect the coordinator address, number of processes and process index in Slurm, Open MPI,
Kubernetes or a TPU pod. `jax.distributed.initialize` calls this function but does not expose its
result, needed to say what is awaited and to check the port: JAX crashes if it is in use."""

eliminate_dead_code = partial_eval.dce_jaxpr
"""Remove equations with unused results from a jaxpr; `jax.jit` does so only during compilation.
Without it, FLOP counts would include operations with unused results."""

nnx_promote_dtype = dtypes.promote_dtype
"""Default of NNX layers' `promote_dtype` argument; `flax.nnx` does not export this default. Without
it, a layer with a custom `promote_dtype` would be adapted as if it had the default."""

is_mutable = scope.in_filter
"""Return whether the `mutable` argument of Linen's `apply` (bool, name, list or DenyList) includes
a collection; there is no public function for that. Without this check, a call could modify the
collection that holds the adapters."""
