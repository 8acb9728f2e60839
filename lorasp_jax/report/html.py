"""Write one self-contained HTML page per run from the files in its folder."""

import base64
import html
import json
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from statistics import median
from typing import Any

from matplotlib.figure import Figure

from lorasp_jax.base.files import as_value_error, join_inside, read_bytes
from lorasp_jax.base.json_values import check
from lorasp_jax.base.writing import write_text
from lorasp_jax.models import presets
from lorasp_jax.report import figures
from lorasp_jax.training import records
from lorasp_jax.training.best import BEST
from lorasp_jax.training.finished_run import recorded_method
from lorasp_jax.training.run_folder import (
    CONFIG_FILE,
    DATASET_FILE,
    STOPPED,
    TIMES_FILE,
    VALIDATION,
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
    """Write report.html into a run's folder, from the records, images and videos there.

    The page of an unfinished run shows partial results and refreshes itself, unless the run
    stopped.

    Raises:
        ValueError: the folder contains no run, or its files are damaged.
    """
    rows = read_metrics(folder)
    config = read_json(folder / CONFIG_FILE, records.CONFIG)
    if not config:
        raise ValueError(f"no run in {folder}: {CONFIG_FILE} is missing")
    finished = read_json(folder / "results.json", records.RESULTS)
    results = finished or _unfinished(folder)
    parts = [
        f"<h1>{html.escape(config['name'])}</h1>",
        f"<p class=muted>{_subtitle(config, results)}</p>",
        *(() if finished else _progress(folder, config, rows)),
        *_success(results),
        *(_kept(folder) if finished and config.get("online") else ()),
        "<h2>Training</h2>",
        *_datasets(folder),
        *_training(rows, config),
        *_held_out(folder, rows),
        *_rules(results),
        *_active_rank(results, rows, folder, config),
        *_media(folder, [t for t in results["tasks"] if finished or _video(folder, t).exists()]),
        "<h2>Time</h2>",
        _table(
            ("phase", "seconds"), ((k, f"{v:.1f}") for k, v in phases(results["seconds"]).items())
        ),
        "<h2>Settings</h2>",
        f"<pre>{html.escape(json.dumps(_used(config), indent=2))}</pre>",
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


def phases(seconds: Mapping[str, float]) -> dict[str, float]:
    """Return the time per phase [s], the total last; "other" is mostly imports."""
    timed = {phase: value for phase, value in seconds.items() if phase != "total"}
    total = seconds.get("total", sum(timed.values()))
    return {**timed, "other": max(total - sum(timed.values()), 0.0), "total": total}


def _unfinished(folder: Path) -> dict[str, Any]:
    """Return the part of results.json that is already available."""
    before = read_json(folder / "before.json", records.BEFORE).items()
    return {
        "seconds": read_json(folder / TIMES_FILE, records.TIMES),
        "tasks": {task: {"before": value} for task, value in before},
        "layer_active_rank": {},
    }


def _progress(folder: Path, config: dict[str, Any], rows: figures.Rows) -> Iterable[str]:
    """Show the progress of an unfinished run, or why it stopped."""
    if stopped := read_json(folder / STOPPED, records.STOPPED):
        yield f"<p><b>The run stopped:</b> {html.escape(stopped['reason'])}.</p>"
        return
    step, steps = rows[-1]["step"] if rows else 0, config["optim"]["steps"]
    yield f"<p>Running: step {step:.0f} of {steps}.</p>"
    yield _REFRESH


def _kept(folder: Path) -> Iterable[str]:
    """Say which adapters a run that learned from success has kept, if it evaluated any."""
    if not (found := read_json(folder / BEST, records.BEST)):
        return
    yield (
        f"<p>The result has the adapters of iteration {found['step']}, the best that were "
        "evaluated, and is measured on other layouts.</p>"
        if found["step"]
        else "<p>No iteration was better than the start, whose adapters are kept: its success "
        "before and after differs by the layouts alone.</p>"
    )


def _datasets(folder: Path) -> Iterable[str]:
    """Show what is drawn from each of several datasets."""
    found = read_json(folder / DATASET_FILE, records.DATASET)
    if each := found.get("facts", {}).get("datasets"):
        header = ("dataset", "episodes", "windows", "share of what is drawn")
        values = ((x["episodes"], x["windows"], f"{100 * x['share']:.1f} %") for x in each)
        rows = ((x["name"], *map(str, row)) for x, row in zip(each, values, strict=True))
        yield _table(header, rows)


def _training(rows: figures.Rows, config: dict[str, Any]) -> Iterable[str]:
    """Show losses, skipped steps and, if measured, success over the steps and speed."""
    if not rows:
        yield "<p>No metrics logged yet.</p>"
    elif online := config.get("online"):
        yield _image(figures.reinforcement(rows, online["worlds"]))
    else:
        yield _image(figures.losses(rows))
    if skipped := [(row["step"], row["skipped"]) for row in rows if row.get("skipped")]:
        total = sum(count for _, count in skipped)
        yield (
            f"<p>{total:.0f} steps were skipped because the loss or the gradient was not finite "
            f"or spiked, first logged at step {skipped[0][0]:.0f}, last at step "
            f"{skipped[-1][0]:.0f}.</p>"
        )
    if any(name.startswith("success/") for row in rows for name in row):
        yield _image(figures.success_over_steps(rows))
    if summary := speed(rows):
        yield _table(("run statistics", ""), summary.items())


def _held_out(folder: Path, rows: figures.Rows) -> Iterable[str]:
    """Show errors on held-out episodes, if there are any."""
    measured = [row for row in rows if "validation/action_error" in row]
    if not measured:
        return
    yield "<h2>Held-out episodes</h2>"
    yield _image(figures.held_out(rows))
    yield f"<p>{held_out_verdict(measured)}</p>"
    if found := read_json(folder / VALIDATION, records.VALIDATION):
        header = (f"mean error at step {found['kept']}", *found["columns"])
        errors = found["errors"].items()
        yield _table(header, ((k, *(f"{x:.2f}" for x in v)) for k, v in errors))
        if len(phrases := found.get("instructions", {})) > 1:  # the worst ones, see `held_out`
            title = "mean error by instruction [standard deviations]"
            header = (title, "policy", "hold still", "repeat previous")
            yield _table(header, ((k, *(f"{x:.3f}" for x in v)) for k, v in phrases.items()))
    for picture in sorted(folder.glob("held_out_*.png")):
        data = base64.b64encode(read_bytes(picture, folder)).decode()
        yield f'<img alt="recorded and predicted joints" src="data:image/png;base64,{data}">'


def _used(config: dict[str, Any]) -> dict[str, Any]:
    """Return the settings without those that a dataset replaces."""
    replaced = ("robot", "tasks") if config["data"]["source"] else ()
    return {name: value for name, value in config.items() if name not in replaced}


def held_out_verdict(rows: figures.Rows) -> str:
    """Say at which step the held-out error was least, and whether training then only overfits.

    A rise by 5 % from the least error to the last counts as overfitting.
    """
    name = "validation/action_error"
    best, last = min(rows, key=lambda row: row[name]), rows[-1]
    floors = [last[f"validation/{floor}/action_error"] for floor in ("hold_still", "repeat")]
    text = f"The action error was least at step {best['step']:.0f}: {best[name]:.3f}"
    if best[name] > min(floors):
        return f"{text}, more than that of a policy that does nothing ({min(floors):.3f})."
    if last[name] > 1.05 * best[name]:
        rise = 100 * (last[name] / best[name] - 1)
        return f"{text}; it then rose by {rise:.0f} %, so that further steps only overfit."
    return f"{text}, a policy that does nothing: {min(floors):.3f}."


def _subtitle(config: dict[str, Any], results: dict[str, Any]) -> str:
    """Describe the run on one line, with parameter counts if it is finished."""
    line = (
        f"{' '.join(config.get('adapt', ())) or config['peft']['method']} on "
        f"{config['model']['backbone']} {config['model']['size']}, "
        f"{_learned_from(config)}"
    )
    if "total_parameters" in results:
        trainable, total = results["trainable_parameters"], results["total_parameters"]
        percentage = 100 * trainable / total
        line += f": {trainable:,} trainable of {total:,} parameters ({percentage:.1f} %)"
    return html.escape(f"{line}, scale {config['scale']}")


def _learned_from(config: dict[str, Any]) -> str:
    """Name the recordings; a dataset also sets the robot, which the config then does not know."""
    source = config.get("data", {}).get("source")
    names = source if isinstance(source, str) else ", ".join(source or ())
    return f"recordings {names}" if names else f"robot {config['robot']}"


def _success(results: dict[str, Any]) -> Iterable[str]:
    """Show success rates if the run was evaluated."""
    if results["tasks"]:
        yield "<h2>Success</h2>"
        yield _image(figures.success(results))
        tasks = results["tasks"]
        header = ("task", *next(iter(tasks.values())))
        yield _table(header, ((k, *map(success_cell, v.values())) for k, v in tasks.items()))


def success_cell(value: dict[str, Any]) -> str:
    """Format a success rate with its interval."""
    low, high = value["ci95"]
    rate = f"{100 * value['success']:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
    return f"{rate} of {value['episodes']}"


def speed(rows: figures.Rows) -> dict[str, str]:
    """Summarize throughput and memory as label -> value with unit.

    Throughput and utilization are medians; "data wait" is a fraction of the whole training time.
    """
    rate, wait = "speed/samples_per_second", "speed/data_wait"
    entries = {
        "samples/s": (rate, median, "{:,.4g}".format),
        "FLOP utilization": ("speed/flop_utilisation", median, "{:.1%}".format),
        "peak memory": ("memory/peak_gib", max, _memory),
    }
    labeled = {}
    for label, (name, reduce, form) in entries.items():
        if values := [row[name] for row in rows if name in row]:
            labeled[label] = form(reduce(values))
    if waits := [row[wait] / row[rate] for row in rows if wait in row]:
        labeled["data wait"] = (
            f"{sum(waits) / sum(1 / row[rate] for row in rows if rate in row):.1%}"
        )
    return labeled


def _memory(gib: float) -> str:
    return f"{gib:.2f} GiB" if gib >= 1 else f"{1024 * gib:.1f} MiB"


def _rules(results: dict[str, Any]) -> Iterable[str]:
    """Show what each rule of `adapt` trains, if the run is finished."""
    if "rules" not in results:
        return
    yield "<h2>Rules</h2>"
    header = ("rule", "layers", "trainable parameters", "active rank in training")
    yield _table(header, ((rule, *_rule_cells(row)) for rule, row in results["rules"].items()))


def _rule_cells(row: dict[str, Any]) -> tuple[str, ...]:
    rank = f"{row['active_rank']:.1f}" if "active_rank" in row else "-"
    return f"{row['layers']:,}", f"{row['parameters']:,}", rank


def _largest_rank(folder: Path, config: dict[str, Any]) -> int:
    """Return the largest active rank that the run's methods allow."""
    if "plan" in config:
        return max(map(max, config["plan"]["ranks"].values()))
    if "adapt" not in config:
        with as_value_error(folder / CONFIG_FILE):
            check(config, records.WITH_RANK)
        method = config["peft"]  # of any version
        return method["rank"] * (method["experts"] if method.get("routing") == "weighted" else 1)
    named = presets.parse(config["adapt"], recorded_method(config["peft"]))
    return max(method.largest_active_rank for _, method in named.values() if method)


def _active_rank(
    results: dict[str, Any], rows: figures.Rows, folder: Path, config: dict[str, Any]
) -> Iterable[str]:
    """Show active rank in training and in closed loop, if a method has one."""
    if not any(name.startswith("active_rank/") for row in rows for name in row):
        return
    rank = _largest_rank(folder, config)
    yield "<h2>Active rank</h2>"
    yield _image(figures.active_rank(rows, rank))
    if not results["layer_active_rank"]:
        return
    where = "closed loop" if results["tasks"] else "training"
    modules = ((module, f"{mean:.1f}") for module, mean in results["active_rank"].items())
    yield _table(("module", f"active rank in {where}"), modules)
    yield _image(figures.layer_ranks(results["layer_active_rank"], rank))
    if results["active_rank_histogram"]:
        yield _image(figures.rank_histogram(results["active_rank_histogram"]))


def _table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return an HTML table; all columns except the first contain numbers."""
    head = "".join(f"<th>{html.escape(name)}</th>" for name in header)
    body = ""
    for first, *rest in rows:
        cells = "".join(f"<td class=number>{html.escape(value)}</td>" for value in rest)
        body += f"<tr><td>{html.escape(first)}</td>{cells}</tr>"
    return f"<table><tr>{head}</tr>{body}</table>"


def _image(figure: Figure) -> str:
    """Embed a figure as <img>, so that the ids in several SVGs do not clash."""
    data = base64.b64encode(figures.svg(figure).encode()).decode()
    return f'<img alt="figure" src="data:image/svg+xml;base64,{data}">'


def _video(folder: Path, task: str) -> Path:
    return join_inside(folder, f"rollout_{task}.mp4")


def _media(folder: Path, tasks: Collection[str]) -> Iterable[str]:
    """Show the first camera images and the video of every task."""
    if tasks:
        yield "<h2>Observations and rollouts</h2>"
    for task in tasks:
        image, video = join_inside(folder, f"cameras_{task}.png"), _video(folder, task)
        if missing := [path.name for path in (image, video) if not path.exists()]:
            names = html.escape(", ".join(missing))
            yield f"<h3>{html.escape(task)}</h3><p>Missing: {names}.</p>"
            continue
        image_data = base64.b64encode(read_bytes(image, folder)).decode()
        yield (
            f"<h3>{html.escape(task)}</h3>"
            f'<figure><img class=camera width=400 alt="side and wrist cameras" '
            f'src="data:image/png;base64,{image_data}">'
            "<figcaption class=muted>side and wrist cameras at policy resolution</figcaption>"
            "</figure>"
        )
        yield _film(video, folder, _EPISODE)
        if (start := join_inside(folder, f"start_{task}.mp4")).exists():
            yield _film(start, folder, "the start policy from the same initial state")


_EPISODE = "a closed-loop episode of the adapted policy, a success if any was recorded"


def _film(path: Path, folder: Path, caption: str) -> str:
    """Embed a video of a run's folder, with a caption."""
    data = base64.b64encode(read_bytes(path, folder)).decode()
    return (
        "<figure><video width=400 controls autoplay loop muted "
        f'src="data:video/mp4;base64,{data}"></video>'
        f"<figcaption class=muted>{caption}</figcaption></figure>"
    )
