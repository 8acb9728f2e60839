"""Draw success and smoothness against delay from docs/latency.json: python docs/figures/latency.py

Writes latency.svg next to this file.
"""

import json
from pathlib import Path

from lorasp_jax.extras.latency import figure

HERE = Path(__file__).parent


def main(path: Path = HERE / "latency.svg") -> None:
    """Draw the runs of docs/latency.json, by title."""
    runs = json.loads((HERE.parent / "latency.json").read_text())
    figure.write(path, [*runs.items()])


if __name__ == "__main__":
    main()
