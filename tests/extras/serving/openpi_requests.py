"""Requests, statistics and chunks for openpi's named configs, by formula; needs only NumPy.

tests/golden/openpi_configs.npz has what openpi's own code makes of them (15a9616a): the input and
output transforms of its `policies.policy_config.create_trained_policy`, with stand-ins for packages
that the transforms do not need, and paligemma_like.model as the tokenizer.
"""

import numpy as np

TEXT = " Pick_up the\n bowl "
"""Prompt of requests to policies without a default."""


def wave(start, *shape):
    return np.sin(np.arange(np.prod(shape)) * 0.7 + start).reshape(shape)


def picture(step, height, width):
    return (np.arange(height * width * 3) * step % 251).astype(np.uint8).reshape(height, width, 3)


def request(robot, start, cameras=3, *, prompt=True):
    """A request for "libero", "droid" or "aloha"; the latter with some of its cameras."""
    first, wrist, other = picture(7, 120, 160), picture(11, 224, 224), picture(13, 240, 180)
    state = 0.8 * wave(start, 14)
    if robot == "libero":
        message = {"observation/state": state[:8]}
        message |= {"observation/image": first, "observation/wrist_image": wrist}
    elif robot == "droid":
        message = {"observation/joint_position": state[:7], "observation/gripper_position": 0.3}
        message |= {"observation/exterior_image_1_left": first}
        message |= {"observation/wrist_image_left": wrist}
    else:
        state[[6, 13]] = 0.2, 0.9
        names = ("cam_high", "cam_left_wrist", "cam_right_wrist")[:cameras]
        pictures = {
            n: x.transpose(2, 0, 1) for n, x in zip(names, (first, wrist, other), strict=False)
        }
        message = {"state": state, "images": pictures}
    return {**message, "prompt": TEXT} if prompt else message


def statistics(start, length):
    """Statistics in openpi's form."""
    mean, std = 0.3 * wave(start, length), 0.6 + 0.2 * wave(start + 1, length)
    stats = {"mean": mean, "std": std, "q01": mean - 1.6 * std, "q99": mean + 2 * std}
    return {name: values.tolist() for name, values in stats.items()}


def chunk(start, *shape):
    return wave(start, *shape).astype(np.float32)
