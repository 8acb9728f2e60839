"""A policy server in openpi's protocol, without a policy."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from websockets.sync.server import serve

from lorasp_jax.extras.serving import wire


@contextlib.contextmanager
def policy_server(act: Callable[[dict[str, Any]], np.ndarray]) -> Iterator[str]:
    """Serve a function from requests to chunks; its ValueErrors are sent as text frames."""

    def answer(socket):
        socket.send(wire.pack({}))
        for frame in socket:
            try:
                reply = wire.pack({"actions": act(wire.unpack(frame))})
            except ValueError as error:
                reply = str(error)
            socket.send(reply)

    with serve(answer, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        server.shutdown()
        thread.join()
