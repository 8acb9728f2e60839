"""Schemas of a run's JSON files.

A digest verifies that a file is intact, but not that this version wrote it.
"""

from typing import Any, TypeAlias

Kind: TypeAlias = dict[Any, Any]
"""Schema of a JSON object, see `storage.json_values.check`."""
TIMES: Kind = {str: float}
RATE: Kind = {"success": float, "episodes": int, "ci95": (float, float)}
BEFORE: Kind = {str: RATE}
RESULTS: Kind = {
    "seconds": TIMES,
    "tasks": {str: {"before": RATE, "after": RATE}},
    "active_rank": {str: float},
    "layer_active_rank": {str: {str: [float]}},
    "active_rank_histogram": {str: [int]},
    "trainable_parameters": int,
    "total_parameters": int,
}
ROW: Kind = {"step": float, str: float}
DATASET: Kind = {"facts": {}, "streams": bool}
STOPPED: Kind = {"reason": str}
CONFIG: Kind = {
    "name": str,
    "scale": str,
    "robot": str,
    "peft": {"method": str},
    "model": {"backbone": str, "size": str},
    "optim": {"steps": int},
}
WITH_RANK: Kind = CONFIG | {"peft": {"method": str, "rank": int}}
