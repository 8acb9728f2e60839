"""Random changes of training images, on the device, by the recipes of openpi and LeRobot."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import augmax
import augmax.utils
import jax
import jax.numpy as jnp

from lorasp_jax.config import AugmentConfig
from lorasp_jax.policies.policy import Observation
from lorasp_jax.policies.processor import Processor

WRIST = ("wrist", "gripper", "hand")
"""A camera with one of these in its name moves with the hand, so it is neither cropped nor rotated;
openpi knows "wrist" alone."""
_GRAY = (0.299, 0.587, 0.114)  # ITU-R BT.601, as in torchvision

Augment = Callable[[jax.Array, jax.Array], jax.Array]
"""Changes one image `[H, W, 3]` in [0, 1] as the key says."""


def augment(
    key: jax.Array, observation: Observation, processor: Processor, settings: AugmentConfig
) -> Observation:
    """Change every image of a batch in its own way; cameras that the robot lacks stay black.

    An image depends only on the key, its row and its camera, so that a batch on several devices
    has the images of a batch on one.

    Args:
        key: consumed.
        observation: the model's input, images `[B, H, W, 3]` in [-1, 1].
        processor: names the robot's cameras.
        settings: whose preset is openpi or lerobot.
    """
    images = dict(observation.images)
    sources = dict(processor.cameras) or {name: name for name in images}
    for number, (slot, camera) in enumerate(sources.items()):
        if camera is not None:
            keys = jax.random.split(jax.random.fold_in(key, number), len(images[slot]))
            change = jax.vmap(recipe(settings, wrist=on_wrist(camera)))
            images[slot] = 2 * change(keys, images[slot] / 2 + 0.5) - 1
    return dataclasses.replace(observation, images=images)


def on_wrist(camera: str) -> bool:
    """Whether a camera moves with the hand, by its name."""
    return any(name in camera for name in WRIST)


def recipe(settings: AugmentConfig, *, wrist: bool = False) -> Augment:
    """Return the function that changes one image of a camera."""
    if settings.preset == "openpi":
        return functools.partial(_openpi, settings.numbers, wrist)
    return functools.partial(_lerobot, settings.numbers)


def _openpi(
    numbers: Mapping[str, float], wrist: bool, key: jax.Array, image: jax.Array
) -> jax.Array:
    """Apply openpi's transforms (models/model.py, preprocess_observation) with its library.

    augmax changes the colors of half of the images, and of those the hue, too; it computes a new
    saturation, but drops it, so that this has no number here.
    """
    height, width = image.shape[:2]
    sizes = int(width * numbers["crop"]), int(height * numbers["crop"])
    turn = numbers["rotation"]
    moves = [augmax.RandomCrop(*sizes), augmax.Resize(width, height), augmax.Rotate((-turn, turn))]
    still = wrist or (numbers["crop"] == 1 and turn == 0)
    strengths = {name: numbers[name] for name in ("brightness", "contrast", "hue")}
    # With a saturation, augmax has a random key for each of the others, even if some are 0.
    jitter = augmax.ColorJitter(**strengths, saturation=1.0)
    chain: Any = augmax.Chain(*([] if still else moves), jitter)
    return chain(key, image)


def _lerobot(numbers: Mapping[str, float], key: jax.Array, image: jax.Array) -> jax.Array:
    """Apply a random subset of LeRobot's transforms (datasets/transforms.py), in their order."""
    choice, *keys = jax.random.split(key, 1 + len(_LEROBOT))
    chosen = jax.random.permutation(choice, len(_LEROBOT)) < numbers["at_most"]
    for apply, name, key in zip(chosen, _LEROBOT, keys, strict=True):
        changed = _LEROBOT[name](numbers, key, image)
        image = jnp.where(apply, jnp.clip(changed, 0, 1), image)
    return image


def _factor(numbers: Mapping[str, float], name: str, key: jax.Array) -> jax.Array:
    """Draw a factor around 1, as torchvision does."""
    spread = numbers[name]
    return jax.random.uniform(key, minval=max(0.0, 1 - spread), maxval=1 + spread)


def _blend(name: str, other: Callable[[jax.Array], jax.Array]) -> Any:
    """Return the transform that mixes an image with, or moves it away from, `other` of it."""

    def transform(numbers: Mapping[str, float], key: jax.Array, image: jax.Array) -> jax.Array:
        factor = _factor(numbers, name, key)
        return factor * image + (1 - factor) * other(image)

    return transform


def _gray(image: jax.Array) -> jax.Array:
    return (image @ jnp.array(_GRAY))[..., None]


def _smooth(image: jax.Array) -> jax.Array:
    """Return torchvision's smooth image: a 3 x 3 mean whose center counts five times, inside."""
    around = sum(jnp.roll(image, (y, x), (0, 1)) for y in (-1, 0, 1) for x in (-1, 0, 1))
    inside = jnp.zeros(image.shape[:2], bool).at[1:-1, 1:-1].set(True)
    return jnp.where(inside[..., None], (around + 4 * image) / 13, image)


def _hue(numbers: Mapping[str, float], key: jax.Array, image: jax.Array) -> jax.Array:
    shift = jax.random.uniform(key, minval=-numbers["hue"], maxval=numbers["hue"])

    def turn(pixel: jax.Array) -> jax.Array:
        hue, saturation, value = augmax.utils.rgb_to_hsv(pixel)
        return augmax.utils.hsv_to_rgb(hue + shift, saturation, value)

    return jax.vmap(jax.vmap(turn))(image)


def _affine(numbers: Mapping[str, float], key: jax.Array, image: jax.Array) -> jax.Array:
    """Rotate about the center and shift by whole pixels, to the nearest pixel; black outside."""
    size = jnp.array(image.shape[:2], jnp.float32)
    angle_key, shift_key = jax.random.split(key)
    limit = jnp.deg2rad(numbers["rotation"])
    angle = jax.random.uniform(angle_key, minval=-limit, maxval=limit)
    shift = numbers["translation"] * size
    shift = jnp.round(jax.random.uniform(shift_key, (2,), minval=-shift, maxval=shift))
    turn = jnp.array([[jnp.cos(angle), -jnp.sin(angle)], [jnp.sin(angle), jnp.cos(angle)]])
    center = (size - 1) / 2
    grid = jnp.stack(jnp.meshgrid(*map(jnp.arange, image.shape[:2]), indexing="ij"), -1)
    rows, columns = jnp.moveaxis((grid - center - shift) @ turn + center, -1, 0).round().astype(int)
    inside = (rows >= 0) & (rows < size[0]) & (columns >= 0) & (columns < size[1])
    return jnp.where(inside[..., None], image[rows, columns], 0)


_LEROBOT: dict[str, Any] = {
    "brightness": _blend("brightness", jnp.zeros_like),
    "contrast": _blend("contrast", lambda image: _gray(image).mean()),
    "saturation": _blend("saturation", _gray),
    "hue": _hue,
    "sharpness": _blend("sharpness", _smooth),
    "affine": _affine,
}
"""LeRobot's transforms by name, each a function of its numbers, a key and an image."""
