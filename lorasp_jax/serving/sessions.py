"""What the server remembers of one connection."""

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from lorasp_jax.serving.requests import Request


@dataclass
class Session:
    """State of one connection.

    The noise of the flow depends only on the server's seed and on the number of requests since the
    episode's start, so an episode can be repeated exactly after a reset.

    Attributes:
        client: distinguishes connections.
        requests: requests since the start of the episode.
        previous: the last chunk of the episode, f32 `[C, J+1]`.
        previous_ms: time from receiving the previous request to having sent its reply.
    """

    client: int
    requests: int = 0
    previous: np.ndarray | None = field(default=None, repr=False)
    previous_ms: float | None = None

    def advance(self, request: Request) -> tuple[Request, int]:
        """Return the request with the previous chunk, and its number in the episode.

        Raises:
            ValueError: it should continue a chunk, but is the first of its episode.
        """
        if request.reset:
            self.requests, self.previous = 0, None
        if request.executed is not None and self.previous is None:
            raise ValueError("the first request of an episode must not have the key executed")
        index = self.requests
        self.requests += 1
        return dataclasses.replace(request, previous=self.previous), index
