"""One self-contained HTML page per run, made from the files in its folder."""

import base64
import html
import json
from collections.abc import Collection, Iterable
from pathlib import Path
from statistics import median
from typing import Any

from matplotlib.figure import Figure

from envs.datasets.files import inside, read_bytes
from envs.datasets.writing import write_text
from lorasp_jax.report import figures
from lorasp_jax.training import records
from lorasp_jax.training.run_folder import (
    CLOCK,
    RECORD,
    STOPPED,
    read_json,
    read_metrics,
)

_REFRESH = "<meta http-equiv=refresh content=30>"

_STYLE = """
:root { color-scheme: light dark; --text: #1b1e23; --muted: #626977; --line: #c9ced6;
        --back: #fff; --box: #f4f5f7; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e3e6ea; --muted: #9aa2ae; --line: #474e58; --back: #16191d; --box: #22262c; }
  img[alt=figure] { filter: invert(.9) hue-rotate(180deg); }
}
body { font: 15px/1.5 system-ui, sans-serif; color: var(--text); background: var(--back);
       max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { margin-bottom: 0; overflow-wrap: anywhere; } h2 { margin-top: 2.2rem; }
.muted { color: var(--muted); }
table { border-collapse: collapse; display: block; overflow-x: auto; }
th, td { padding: .25rem .9rem .25rem 0; text-align: left; }
th { border-bottom: 1px solid var(--line); font-weight: 600; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
img, video { max-width: 100%; height: auto; }
img[alt=figure] { display: block; margin: 1rem 0; }
figure { display: inline-block; margin: 0 1rem 1rem 0; max-width: 100%; }
video, .camera { image-rendering: pixelated; background: var(--box); }
pre { background: var(--box); padding: 1rem; overflow-x: auto; font-size: 13px; }
"""


def write_report(folder: Path) -> Path:
    """Write `folder`/report.html from its results.json, metrics.jsonl, config.json and videos.

    Of a run without results.json it has what there is so far, and loads itself again and again.

    Raises:
        ValueError: the folder holds no run, or damaged files.
    """
    rows = read_metrics(folder)
    config = read_json(folder / RECORD, records.WITH_RANK if _has_rank(rows) else records.CONFIG)
    if not config:
        raise ValueError(f"{folder} holds no run: there is no {RECORD}")
    finished = read_json(folder / "results.json", records.RESULTS)
    results = finished or _unfinished(folder)
    parts = [
        f"<h1>{html.escape(config['name'])}</h1>",
        f"<p class=muted>{_subtitle(config, results)}</p>",
        *(() if finished else _progress(folder, config, rows)),
        *_success(results),
        "<h2>Training</h2>",
        _image(figures.losses(rows)) if rows else "<p>Nothing is logged yet.</p>",
        *_skipped(rows),
        *_while_training(rows),
        *_speed(rows),
        *_active_rank(results, rows, config["peft"].get("rank")),
        *_media(folder, [t for t in results["tasks"] if finished or _filmed(folder, t).exists()]),
        "<h2>Time</h2>",
        _table(("phase", "seconds"), ((k, f"{v:.1f}") for k, v in results["seconds"].items())),
        "<h2>Settings</h2>",
        f"<pre>{html.escape(json.dumps(config, indent=2))}</pre>",
    ]
    page = (
        "<!doctype html><html lang=en><meta charset=utf-8>"
        "<meta name=viewport content='width=device-width, initial-scale=1'>"
        f"<title>{html.escape(config['name'])}</title><style>{_STYLE}</style>"
        + "\n".join(parts)
        + "</html>\n"
    )
    path = folder / "report.html"
    write_text(path, page)
    return path


def _unfinished(folder: Path) -> dict[str, Any]:
    """What results.json will have, as far as it is known."""
    before = read_json(folder / "before.json", records.BEFORE).items()
    return {
        "seconds": read_json(folder / CLOCK, records.TIMES),
        "tasks": {task: {"before": value} for task, value in before},
        "layer_active_rank": {},
    }


def _progress(folder: Path, config: dict[str, Any], rows: figures.Rows) -> Iterable[str]:
    """How far a run is that is not finished; or why it stopped."""
    stopped = read_json(folder / STOPPED, records.STOPPED)
    if stopped:
        yield f"<p><b>The run stopped:</b> {html.escape(stopped['reason'])}.</p>"
        return
    done, steps = rows[-1]["step"] if rows else 0, config["optim"]["steps"]
    yield f"<p>The run goes on: step {done:.0f} of {steps}.</p>"
    yield _REFRESH


def _skipped(rows: figures.Rows) -> Iterable[str]:
    """How many steps were skipped, if any were."""
    found = [(row["step"], row["skipped"]) for row in rows if row.get("skipped")]
    if found:
        yield (
            f"<p>{sum(count for _, count in found):.0f} steps were skipped, as loss or gradient "
            f"was not finite or a spike: the first up to step {found[0][0]:.0f}, the last up to "
            f"{found[-1][0]:.0f}.</p>"
        )


def _subtitle(config: dict[str, Any], results: dict[str, Any]) -> str:
    """One line: method, backbone, robot, at the end of a run parameters, scale."""
    line = (
        f"{config['peft']['method']} on {config['model']['backbone']} {config['model']['size']}, "
        f"robot {config['robot']}"
    )
    if "total_parameters" in results:
        trainable, total = results["trainable_parameters"], results["total_parameters"]
        share = 100 * trainable / total
        line += f": {trainable:,} trainable of {total:,} parameters ({share:.1f} %)"
    return html.escape(f"{line}, scale {config['scale']}")


def _success(results: dict[str, Any]) -> Iterable[str]:
    """Success rates; nothing for a run that was not evaluated."""
    if results["tasks"]:
        yield "<h2>Success before and after</h2>"
        yield _image(figures.success(results))
        yield _success_table(results)


def _while_training(rows: figures.Rows) -> Iterable[str]:
    """Success over the steps; nothing for a run that did not measure it."""
    if any(name.startswith("success/") for row in rows for name in row):
        yield _image(figures.success_over_steps(rows))


def _success_table(results: dict[str, Any]) -> str:
    """Task, before, after, with intervals."""
    tasks = results["tasks"].items()
    rows = ((task, *map(success_cell, value.values())) for task, value in tasks)
    return _table(("task", *next(iter(results["tasks"].values()))), rows)


def success_cell(value: dict[str, Any]) -> str:
    """A success rate with its interval."""
    low, high = value["ci95"]
    rate = f"{100 * value['success']:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
    return f"{rate} of {value['episodes']}"


def _speed(rows: figures.Rows) -> Iterable[str]:
    """What was measured beside the losses; nothing for a run that logged none of it."""
    found = speed(rows)
    if found:
        yield _table(("over the run", ""), found.items())


def speed(rows: figures.Rows) -> dict[str, str]:
    """What a run's rows say of its speed and memory, with units, by what it is.

    Medians; of waiting the share of all time, of memory the highest.
    """
    known = {
        "samples a second": ("speed/samples_per_second", median, "{:,.4g}".format),
        "FLOP utilisation": ("speed/flop_utilisation", median, "{:.1%}".format),
        "time waiting for data": ("waited", sum, "{:.1%}".format),
        "memory at its highest": ("memory/peak_gib", max, _memory),
    }
    found, rows = {}, [*_waited(rows)]
    for label, (name, summary, form) in known.items():
        values = [row[name] for row in rows if name in row]
        if values:
            found[label] = form(summary(values))
    return found


def _memory(gib: float) -> str:
    """Memory in a unit that suits it."""
    return f"{gib:.2f} GiB" if gib >= 1 else f"{1024 * gib:.1f} MiB"


def _waited(rows: figures.Rows) -> Iterable[dict[str, float]]:
    """The rows, with "waited": the share of the run's time that passed waiting in theirs."""
    rate, wait = "speed/samples_per_second", "speed/data_wait"
    every = sum(1 / row[rate] for row in rows if rate in row)
    for row in rows:
        yield row | {"waited": row[wait] / row[rate] / every} if wait in row else row


def _has_rank(rows: figures.Rows) -> bool:
    return any(name.startswith("active_rank/") for row in rows for name in row)


def _active_rank(results: dict[str, Any], rows: figures.Rows, rank: Any) -> Iterable[str]:
    """Active rank in training and in closed loop; nothing for a method without one."""
    if not _has_rank(rows):
        return
    yield "<h2>Active rank</h2>"
    yield _image(figures.active_rank(rows, rank))
    if not results["layer_active_rank"]:  # not evaluated
        return
    modules = ((module, f"{mean:.1f}") for module, mean in results["active_rank"].items())
    yield _table(("module", "active rank in closed loop"), modules)
    yield _image(figures.layer_ranks(results["layer_active_rank"], rank))
    if results["active_rank_histogram"]:
        yield _image(figures.rank_histogram(results["active_rank_histogram"]))


def _table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """An HTML table; every column but the first holds numbers."""
    head = "".join(f"<th>{html.escape(name)}</th>" for name in header)
    body = ""
    for first, *rest in rows:
        cells = "".join(f"<td class=number>{html.escape(value)}</td>" for value in rest)
        body += f"<tr><td>{html.escape(first)}</td>{cells}</tr>"
    return f"<table><tr>{head}</tr>{body}</table>"


def _image(figure: Figure) -> str:
    """A figure as an image of its own, so that identifiers of several do not clash."""
    data = base64.b64encode(figures.svg(figure).encode()).decode()
    return f'<img alt="figure" src="data:image/svg+xml;base64,{data}">'


def _filmed(folder: Path, task: str) -> Path:
    """The video of a task."""
    return inside(folder, f"rollout_{task}.mp4")


def _media(folder: Path, tasks: Collection[str]) -> Iterable[str]:
    """Video and first camera pictures of every task."""
    if tasks:
        yield "<h2>What the policy sees and does</h2>"
    for task in tasks:
        picture, video = inside(folder, f"cameras_{task}.png"), _filmed(folder, task)
        if missing := [path.name for path in (picture, video) if not path.exists()]:
            gone = html.escape(" and ".join(missing))
            yield f"<h3>{html.escape(task)}</h3><p>{gone} missing.</p>"
            continue
        shown = base64.b64encode(read_bytes(picture, folder)).decode()
        played = base64.b64encode(read_bytes(video, folder)).decode()
        yield (
            f"<h3>{html.escape(task)}</h3>"
            f'<figure><img class=camera width=400 alt="side and wrist camera" '
            f'src="data:image/png;base64,{shown}">'
            "<figcaption class=muted>side and wrist camera at policy resolution</figcaption>"
            "</figure>"
            "<figure><video width=400 controls autoplay loop muted "
            f'src="data:video/mp4;base64,{played}"></video>'
            "<figcaption class=muted>one closed-loop episode of the adapted policy</figcaption>"
            "</figure>"
        )
