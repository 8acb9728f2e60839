"""What all SVG figures of this project have in common."""

from typing import Any

COLORS = {"vision": "#4269d0", "language": "#efb118", "action": "#3ca951", "before": "#9498a0"}
"""Color of each tower in every figure; results before training are gray."""

STYLE: Any = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "svg.fonttype": "path",
    "svg.hashsalt": "lorasp_jax",
}
"""Settings of matplotlib; with them, the same figure is the same file."""
