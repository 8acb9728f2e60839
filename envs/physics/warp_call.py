"""Call functions of Warp arrays from JAX."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import warp as wp


def device() -> Any:
    """Return the Warp device that JAX computes on."""
    return wp.device_from_jax(jax.local_devices()[0])


def from_jax(function: Callable[..., None], like: Mapping[str, Any], **options: Any) -> Any:
    """Make a function of Warp arrays callable under jit.

    On a GPU, the first call of `function` is captured as a CUDA graph, so memory that outlives a
    call must be allocated beforehand. Warp copies arguments and results to and from the graph's
    buffers.

    Args:
        function: takes arrays as positional arguments, the outputs last.
        like: argument name -> a Warp array of the same dtype and number of axes.
        **options: passed to `warp.jax_callable`.
    """
    kinds = {name: wp.array(dtype=x.dtype, ndim=x.ndim) for name, x in like.items()}
    # Warp reads names and types of the arrays from the signature.
    function.__annotations__ = kinds
    function.__signature__ = inspect.Signature(
        [
            inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=kind)
            for name, kind in kinds.items()
        ]
    )
    modes = wp.JaxCallableGraphMode
    mode = modes.NONE if jax.default_backend() == "cpu" else modes.WARP_STAGED
    return wp.jax_callable(function, graph_mode=mode, vmap_method=None, **options)


def flattening_vmap(function: Callable[..., Any]) -> Callable[..., Any]:
    """Make `vmap` fold its axis into the leading axis of all arrays, the axis of worlds."""

    @jax.custom_batching.custom_vmap
    def run(*arguments: Any) -> Any:
        return function(*arguments)

    @run.def_vmap
    def _(size: int, batched: Sequence[Any], *arguments: Any) -> Any:
        def flat(x: jax.Array, is_batched: bool) -> jax.Array:
            x = x if is_batched else jnp.broadcast_to(x, (size, *x.shape))
            return x.reshape(-1, *x.shape[2:])

        results = run(*jax.tree.map(flat, list(arguments), list(batched)))
        results = jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), results)
        return results, jax.tree.map(lambda _: True, results)

    return run
