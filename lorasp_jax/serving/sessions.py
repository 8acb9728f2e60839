"""What the server remembers of one connection."""

from dataclasses import dataclass


@dataclass
class Session:
    """State of one connection.

    The noise of the flow depends only on the server's seed and on the number of requests since the
    episode's start, so an episode can be repeated exactly after a reset.

    Attributes:
        client: distinguishes connections.
        requests: requests since the start of the episode.
        previous_ms: time from receiving the previous request to having sent its reply.
    """

    client: int
    requests: int = 0
    previous_ms: float | None = None

    def advance(self, reset: bool) -> int:
        """Return the index of this request in its episode, starting a new one if `reset`."""
        index = 0 if reset else self.requests
        self.requests = index + 1
        return index
