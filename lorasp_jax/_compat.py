"""What this package needs of JAX and Flax beyond their public names; no other module here imports
such names.

Each is there in JAX 0.10.2, 0.11.2 and 0.12.0.1 with Flax 0.12.8 and 0.12.12; where a later version
moves one, this file follows.
"""

from flax.core import scope
from flax.nnx.nn import dtypes
from jax._src import clusters
from jax.interpreters import partial_eval

find_processes = clusters.ClusterEnv.auto_detect_unset_distributed_params
"""Where the processes of a run meet, how many they are and this one's number, from Slurm, Open MPI,
Kubernetes or a TPU pod. `jax.distributed.initialize` asks it too, but does not tell: without it the
processes could not compare versions before JAX connects them."""

without_unused = partial_eval.dce_jaxpr
"""A jaxpr without equations that no result needs; `jax.jit` removes them only while compiling.
Without it operations whose result is dropped would count as work."""

nnx_promote_dtype = dtypes.promote_dtype
"""The default of the argument `promote_dtype` of NNX's layers, which `flax.nnx` does not export.
Without it a layer with a promotion of its own would be adapted as if it had none."""

is_mutable = scope.in_filter
"""Whether a name is among the collections that Linen's `apply` was told are mutable; the ways to
say that (a bool, a name, a list, a DenyList) have no public reader. Without it a call could change
the collection that holds the adapters."""
