"""Confidence intervals of success rates."""

import math


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Return the Wilson score interval of a success rate.

    Wilson 1927, J. Am. Stat. Assoc. 22, 209-212.

    Args:
        successes: number of successful trials.
        trials: number of trials, at least 1.
        z: quantile of the standard normal distribution; the default gives a 95 % interval.

    Returns:
        The lower and the upper bound.
    """
    rate = successes / trials
    spread = z * math.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2))
    center = rate + z**2 / (2 * trials)
    scale = 1 + z**2 / trials
    return max((center - spread) / scale, 0.0), min((center + spread) / scale, 1.0)
