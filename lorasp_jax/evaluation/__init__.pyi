# Public names: `__init__.py` imports each on first access.
from .results import Result as Result
from .results import evaluate as evaluate
from .rollout import make_rollout as make_rollout
