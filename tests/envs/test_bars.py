"""What progress bars say."""

import pytest

from envs import bars


@pytest.mark.parametrize(
    ("episodes", "seconds", "text"),
    [(0, 9.0, ""), (1, 40.0, "40.0 s an episode"), (64, 20.0, "3.2 episodes/s")],
)
def test_a_rate_is_never_zero(episodes, seconds, text):
    assert bars._rate(episodes, seconds) == text
