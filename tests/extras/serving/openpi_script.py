"""Run by the tests in an environment with openpi's client, without this project: see its requests.

    python openpi_script.py PORT TOKEN FORM...

Requests are those of openpi's examples/simple_client/main.py. Prints a line of JSON per form.
"""

import json
import sys

import numpy as np
from openpi_client import action_chunk_broker, image_tools, websocket_client_policy


def picture(*shape):
    return np.random.default_rng(0).integers(256, size=shape, dtype=np.uint8)


OBSERVATIONS = {
    "LIBERO": {
        "observation/state": np.random.default_rng(0).random(8),
        "observation/image": image_tools.resize_with_pad(picture(256, 256, 3), 224, 224),
        "observation/wrist_image": picture(224, 224, 3),
        "prompt": "do something",
    },
    "DROID": {
        "observation/exterior_image_1_left": picture(224, 224, 3),
        "observation/wrist_image_left": picture(224, 224, 3),
        "observation/joint_position": np.random.default_rng(0).random(7),
        "observation/gripper_position": np.random.default_rng(0).random(1),
        "prompt": "do something",
    },
    "ALOHA": {
        "state": np.ones((14,)),
        "images": {
            "cam_high": picture(3, 224, 224),
            "cam_low": picture(3, 224, 224),
            "cam_left_wrist": picture(3, 224, 224),
            "cam_right_wrist": picture(3, 224, 224),
        },
        "prompt": "do something",
    },
}

port, token, *forms = sys.argv[1:]
for form in forms:
    policy = websocket_client_policy.WebsocketClientPolicy("127.0.0.1", int(port), token or None)
    replies = [policy.infer(OBSERVATIONS[form]) for _ in range(2)]
    broker = action_chunk_broker.ActionChunkBroker(policy, action_horizon=10)
    steps = [broker.infer(OBSERVATIONS[form])["actions"] for _ in range(11)]
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
