"""Private JAX and Flax APIs that this package needs; no other module imports any.

All exist in JAX 0.10.2, 0.11.2 and 0.12.0.1 with Flax 0.12.8 and 0.12.12. If a later version moves
one, only this file changes.
"""

from flax.core import scope
from flax.nnx.nn import dtypes
from jax._src import clusters
from jax.interpreters import partial_eval

find_processes = clusters.ClusterEnv.auto_detect_unset_distributed_params
"""Detect coordinator address, number of processes and process index from Slurm, Open MPI,
Kubernetes or a TPU pod. `jax.distributed.initialize` calls it but does not expose the result, which
the processes need to compare versions before JAX connects them."""

eliminate_dead_code = partial_eval.dce_jaxpr
"""Remove equations with unused results from a jaxpr; `jax.jit` does so only during compilation.
Without it, operations with unused results would count as work."""

nnx_promote_dtype = dtypes.promote_dtype
"""Default of the `promote_dtype` argument of NNX layers, which `flax.nnx` does not export. Without
it, a layer with a custom function would be adapted as if it had the default."""

is_mutable = scope.in_filter
"""Return whether the `mutable` argument of Linen's `apply` (bool, name, list or DenyList) includes
a collection; there is no public function for it. Without it, a call could modify the collection
that holds the adapters."""
