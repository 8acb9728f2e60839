"""Schemas of a run's JSON files.

A file's digest shows that the file is intact. Its schema shows that this version can use it.
"""

from typing import Any, TypeAlias

Schema: TypeAlias = dict[Any, Any]
"""Schema of a JSON object (see `base.json_values.check`)."""
TIMES: Schema = {str: float}
RATE: Schema = {"success": float, "episodes": int, "ci95": (float, float), "outcomes?": str}
BEFORE: Schema = {str: RATE}
RESULTS: Schema = {
    "seconds": TIMES,
    "tasks": {str: {"before?": RATE, "after": RATE}},
    "active_rank": {str: float},
    "layer_active_rank": {str: {str: [float]}},
    "active_rank_histogram": {str: [int]},
    "trainable_parameters": int,
    "total_parameters": int,
    "rules?": {str: {"layers": int, "parameters": int, "active_rank?": float}},
}
ROW: Schema = {"step": float, str: float}
DATASETS: Schema = {"name": str, "episodes": int, "windows": int, "share": float}
DATASET: Schema = {"facts": {"datasets?": [DATASETS]}, "streams": bool}
TAUGHT: Schema = {"robot?": str, "tasks?": [str], "physics_dt?": float}
BEST: Schema = {"step": int, "error": float, "weights": str}
VALIDATION: Schema = {
    "episodes": [int],
    "kept": int,
    "columns": [str],
    "errors": {str: [float]},
    "horizon": [float],
    "instructions?": {str: [float]},
}
STOPPED: Schema = {"reason": str}
CONFIG: Schema = {
    "name": str,
    "scale": str,
    "robot": str,
    "peft": {"method": str},
    "model": {"backbone": str, "size": str},
    "optim": {"steps": int},
    "scene?": {str: (float, float)},
    "adapt?": [str],
    "plan?": {"ranks": {str: [int]}},
}
WITH_RANK: Schema = CONFIG | {"peft": {"method": str, "rank": int}}
