# Public names: `__init__.py` imports each on first access.
from .held_out_run import measure_held_out as measure_held_out
from .programs import make_rollout as make_rollout
from .results import Result as Result
from .results import evaluate as evaluate
