"""Run by the tests in an environment with openpi's client, without this project.

    python openpi_script.py PORT TOKEN SHAPES

SHAPES is JSON: form -> key -> the shape of its value. Prints a line of JSON per form.
"""

import json
import sys

import numpy as np
from openpi_client import action_chunk_broker, websocket_client_policy


def draw(shape):
    """Return a picture or a vector of a shape, or a map of them."""
    if isinstance(shape, dict):
        return {key: draw(each) for key, each in shape.items()}
    rng = np.random.default_rng(0)
    return rng.integers(256, size=shape, dtype=np.uint8) if len(shape) == 3 else rng.random(shape)


port, token, shapes = sys.argv[1:]
for form, each in json.loads(shapes).items():
    observation = {**draw(each), "prompt": "do something"}
    policy = websocket_client_policy.WebsocketClientPolicy("127.0.0.1", int(port), token or None)
    replies = [policy.infer(observation) for _ in range(2)]
    broker = action_chunk_broker.ActionChunkBroker(policy, action_horizon=10)
    steps = [broker.infer(observation)["actions"] for _ in range(11)]
    try:
        policy.infer({"observation/state": "nonsense"})
        error = ""
    except RuntimeError as refusal:
        error = str(refusal)
    result = {
        "form": form,
        "numpy": np.__version__,
        "metadata": policy.get_server_metadata(),
        "shape": replies[0]["actions"].shape,
        "dtype": str(replies[0]["actions"].dtype),
        "timing": replies[1]["server_timing"],
        "steps": [list(step.shape) for step in steps],
        "error": error,
    }
    print(json.dumps(result))
