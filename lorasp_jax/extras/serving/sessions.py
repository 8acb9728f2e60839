"""What the server remembers of one connection."""

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from lorasp_jax.extras.serving.requests import Request


@dataclass
class Session:
    """State of one connection.

    The noise of the flow depends only on the server's seed and on the numbers of the connection and
    of the request on it, so the n-th connection to a server can be repeated exactly. Neither a
    reset nor a new connection starts the noise again: an unlucky draw would be that of every
    episode.

    Attributes:
        client: number of the connection.
        requests: requests on this connection.
        previous: the last chunk of the episode, f32 `[C, J+1]`.
        previous_ms: time from receiving the previous request to having sent its reply.
    """

    client: int
    requests: int = 0
    previous: np.ndarray | None = field(default=None, repr=False)
    previous_ms: float | None = None

    def advance(self, request: Request) -> tuple[Request, tuple[int, int]]:
        """Return the request with the previous chunk, and its index as in `Rows`.

        Raises:
            ValueError: it should continue a chunk, but is the first of its episode.
        """
        if request.reset:
            self.previous = None
        if request.executed is not None and self.previous is None:
            raise ValueError("the first request of an episode must not have the key executed")
        index = self.client, self.requests
        self.requests += 1
        return dataclasses.replace(request, previous=self.previous), index
