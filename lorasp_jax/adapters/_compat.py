"""Private Flax APIs that this package needs; no other module of it imports any.

They exist in Flax 0.12.8 and 0.12.12.
"""

from flax.core import scope
from flax.nnx.nn import dtypes

nnx_promote_dtype = dtypes.promote_dtype
"""Default of NNX layers' `promote_dtype` argument; `flax.nnx` does not export this default. Without
it, a layer with a custom `promote_dtype` would be adapted as if it had the default."""

is_mutable = scope.in_filter
"""Return whether the `mutable` argument of Linen's `apply` (bool, name, list or DenyList) includes
a collection; there is no public function for that. Without this check, a call could modify the
collection that holds the adapters."""
