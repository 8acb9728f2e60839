# Public names: `__init__.py` imports each on first access.
from .export import load_policy as load_policy
