"""Success rates with intervals."""

import math


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson score interval of a success rate (Wilson 1927, J. Am. Stat. Assoc. 22, 209-212).

    Args:
        successes: number of successful trials.
        trials: number of trials, at least 1.
        z: normal quantile; the default gives 95 %.

    Returns:
        Lower and upper bound of the rate.

    Raises:
        ValueError: `trials` is not positive or `successes` lies outside 0..`trials`.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"{successes} successes in {trials} trials is not a success rate")
    rate = successes / trials
    spread = z * math.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2))
    centre = rate + z**2 / (2 * trials)
    scale = 1 + z**2 / trials
    return max((centre - spread) / scale, 0.0), min((centre + spread) / scale, 1.0)
