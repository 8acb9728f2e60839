"""Types of command-line arguments, for argparse."""

import argparse
import math
import re
from pathlib import Path

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
"""Names that are also names of folders."""


def positive(text: str) -> int:
    """Parse a positive integer."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a positive whole number, got {text!r}")
    return int(text)


def seed(text: str) -> int:
    """Parse a seed of up to 32 bits; JAX would ignore higher bits."""
    if not 0 <= (value := int(text)) < 2**32:
        raise argparse.ArgumentTypeError(f"must be 0 to {2**32 - 1}, got {value}")
    return value


def not_negative(text: str) -> float:
    """Parse a finite number of at least 0, such as a duration."""
    if not 0 <= (value := float(text)) < math.inf:
        raise argparse.ArgumentTypeError(f"must be finite and at least 0, got {text!r}")
    return value


def indices(text: str) -> tuple[int, ...]:
    """Parse "none", or indices and ranges of them, as in 0-5,7."""
    if text == "none":
        return ()
    if not re.fullmatch(r"\d{1,4}(-\d{1,4})?(,\d{1,4}(-\d{1,4})?)*", text):
        raise argparse.ArgumentTypeError(f"must be none, or numbers such as 0-5,7, got {text!r}")
    ends = [part.split("-") for part in text.split(",")]
    ranges = [range(int(part[0]), int(part[-1]) + 1) for part in ends]
    if not all(ranges):
        raise argparse.ArgumentTypeError(f"ranges must ascend, got {text!r}")
    return tuple(index for each in ranges for index in each)


def pair(text: str) -> tuple[str, str]:
    """Parse NAME=VALUE."""
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise argparse.ArgumentTypeError(f"must be NAME=VALUE, got {text!r}")
    return name, value


def named(text: str) -> tuple[str, str]:
    """Parse [NAME=]PATH; without a name, the last part of the path is the name."""
    if "=" not in text or Path(text).exists():  # a path may contain the character
        return Path(text).name, text
    return pair(text)
