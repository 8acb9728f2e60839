# Public names: `__init__.py` imports each on first access.
from . import cache as cache
from .opening import open_source as open_source
from .stream import Stream as Stream
