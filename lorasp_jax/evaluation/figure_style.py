"""What all SVG figures of this project have in common."""

from typing import Any

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
