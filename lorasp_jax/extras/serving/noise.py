"""The noise from which the server's policies make actions."""

import jax


def draw(key: jax.Array, index: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Draw the noise of one request, f32 of a shape.

    Args:
        key: of the server.
        index: int32 `[2]`, numbers of the connection and of the request on it.
        shape: `(C, A)`.
    """
    connection, request = index
    key = jax.random.fold_in(jax.random.fold_in(key, connection), request)
    return jax.random.normal(key, shape)
