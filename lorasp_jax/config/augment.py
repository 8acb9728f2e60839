"""Settings of the augmentation of training images."""

from dataclasses import dataclass, replace
from typing import Any, Literal

from lorasp_jax.peft.fields import at_least, check_fields, require

_AUGMENT = {
    "openpi": {"crop": 0.95, "rotation": 5.0, "brightness": 0.3, "contrast": 0.4, "hue": 0.1},
    "lerobot": {"rotation": 5.0, "translation": 0.05, "brightness": 0.2, "contrast": 0.2}
    | {"saturation": 0.5, "hue": 0.05, "sharpness": 0.5, "at_most": 3},
}
"""Presets of `AugmentConfig`: openpi's models/model.py with augmax's default hue, and LeRobot's
datasets/transforms.py."""


@dataclass(frozen=True)
class AugmentConfig:
    """Random changes of training images. A number that is not given is the preset's."""

    preset: Literal["auto", "none", "openpi", "lerobot"] = "auto"
    """The recipe of openpi or LeRobot; auto: for recordings openpi's colors alone, which gain in
    the shifted scene of studies/few and cost least in the recorded one, for simulation none."""
    crop: float | None = None
    """Side of a random crop, relative to the image's (openpi, not for wrist cameras)."""
    rotation: float | None = None
    """Largest rotation [degrees] (not for wrist cameras in openpi)."""
    translation: float | None = None
    """Largest shift, relative to the image's side (LeRobot)."""
    brightness: float | None = None
    """Largest change of brightness."""
    contrast: float | None = None
    """Largest change of contrast."""
    saturation: float | None = None
    """Largest change of saturation (LeRobot)."""
    hue: float | None = None
    """Largest change of hue [turns of the color circle]."""
    sharpness: float | None = None
    """Largest change of sharpness (LeRobot)."""
    at_most: int | None = None
    """Number of kinds of change applied to an image (LeRobot)."""

    @property
    def given(self) -> dict[str, float]:
        """The numbers that are not the preset's."""
        return {name: x for name, x in vars(self).items() if name != "preset" and x is not None}

    @property
    def numbers(self) -> dict[str, float]:
        """The numbers of the recipe."""
        return {**_AUGMENT[self.preset], **self.given}

    def chosen(self, *, simulated: bool) -> "AugmentConfig | None":
        """Return the recipe for recordings or simulated episodes; None if images stay as they are.

        Raises:
            ValueError: a number is given that the recipe does not have.
        """
        if self.preset == "auto":
            if simulated:
                return replace(self, preset="none").chosen(simulated=True)
            still: dict[str, Any] = {"crop": 1.0, "rotation": 0.0}
            return replace(self, preset="openpi", **(still | self.given))
        valid = _AUGMENT.get(self.preset, {})
        for name in self.given.keys() - valid:
            names = ", ".join(valid) or "no numbers"
            raise ValueError(f"data.augment.{name}: preset {self.preset} has {names}")
        return None if self.preset == "none" else self

    def __post_init__(self) -> None:
        check_fields(self)
        at_least(0, self, *self.given, prefix="data.augment.")
        valid = self.crop is None or 0 < self.crop <= 1
        require(valid, "data.augment.crop must lie in (0, 1]", self.crop)
        if self.preset != "auto":
            self.chosen(simulated=False)
