"""Draw loss curves with frozen weights in bf16 and float8: python studies/performance/float8.py

Reads float8.json and writes float8.svg, both next to this file.
"""

import json
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from lorasp_jax.evaluation.figure_style import STYLE

HERE = Path(__file__).parent
COLORS = {"bf16": "#4269d0", "float8": "#ff725c"}
SKIPPED = 20
"""The first 1/20 of the steps is not shown; the loss falls too fast there."""


@mpl.rc_context(STYLE)
def main(path: Path = HERE / "float8.svg") -> None:
    """Draw the loss of all runs in float8.json, one panel per backbone and size."""
    runs = json.loads((HERE / "float8.json").read_text())
    small = runs["small"]
    panels = {
        "π0 small, three seeds": small["pi0"],
        "SmolVLA small, three seeds": small["smolvla"],
        "π0, published size": {kind: [run] for kind, run in runs["base"].items()},
    }
    figure = Figure(figsize=(9.6, 3.2), layout="constrained")
    for axes, (title, kinds) in zip(figure.subplots(1, len(panels)), panels.items(), strict=True):
        axes.set_title(title, loc="left")
        axes.set_xlabel("step")
        for kind, color in COLORS.items():
            for i, run in enumerate(kinds[kind]):
                points = [(int(step), loss) for step, loss in run["loss"].items()]
                steps, losses = zip(
                    *(p for p in points if p[0] > points[-1][0] // SKIPPED), strict=True
                )
                axes.plot(steps, losses, lw=1.2, color=color, label=None if i else kind)
        axes.set_ylim(bottom=0)
    figure.axes[0].set_ylabel("training loss")
    figure.axes[0].legend(frameon=False)
    figure.savefig(path, format="svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
