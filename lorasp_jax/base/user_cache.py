"""Where downloads, compiled programs and contact sheets of this user are kept."""

import os
from pathlib import Path


def user_cache() -> Path:
    """Return our folder in XDG_CACHE_HOME, by default in ~/.cache.

    Raises:
        ValueError: there is no home directory, as for a service's or a container's user.
    """
    try:
        cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:
        text = "this user has no home directory: set HOME to a folder that can be written to"
        raise ValueError(text) from None
    return Path(cache) / "lorasp_jax"
