# Public names: `__init__.py` imports each on first access.
from .programs import make_rollout as make_rollout
from .results import Result as Result
from .results import evaluate as evaluate
