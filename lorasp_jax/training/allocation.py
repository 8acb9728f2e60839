"""Make a plan of ranks from the active ranks of a finished run."""

import functools
import re
from pathlib import Path

from flax import nnx

from lorasp_jax.adapters.io import native
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.peft.plan import RankPlan, Shapes, allocate
from lorasp_jax.training import export, records, rules
from lorasp_jax.training.run_folder import read_json

RESULTS = "results.json"
METHODS = ("lora_sp", "lora_sp_release", "ada_lora")
"""Methods whose layers differ in active rank."""


def from_run(run: Path, *, rank: float | None = None, least: int = 1, drop: int = 0) -> RankPlan:
    """Return a plan with ranks in proportion to the mean active ranks of a run's layers.

    These are from the run's final evaluation or, without one, from the end of its training; see
    `plan.allocate`.

    Args:
        run: folder of a finished run of one of `METHODS`.
        rank: the plan may have as many parameters as this rank in every layer; None: the run's mean
            active rank.
        least: smallest rank.
        drop: how many layers, those with the lowest active rank, get no adapter.

    Raises:
        ValueError: the run is not finished, has another method, or recorded no ranks; or `rank` is
            above the run's own or too small for `least`.
    """
    recorded = export.RecordedPolicy.read(run)
    saved = {} if recorded.is_full else native.read_description(run)
    methods = saved.get("methods", {})
    names = {settings["method"] for settings in methods.values()} or {"full"}
    if len(names) > 1 or names.isdisjoint(METHODS):
        raise ValueError(
            f"{run} was trained with {', '.join(sorted(names))}: a plan is made from the active "
            f"ranks of a run of {' or '.join(METHODS)}"
        )
    if not (results := read_json(run / RESULTS, records.RESULTS)):
        raise ValueError(f"{run} is not a finished run: it needs {RESULTS}")
    try:
        found = results["layer_active_rank"]
        ranks = {path: found[rules.tower(path)][rules.short_name(path)] for path in methods}
    except KeyError as error:
        raise ValueError(f"{run / RESULTS} has no active ranks of {error}") from error
    sizes = shapes(recorded.config, frozenset(methods))
    most = max(settings["rank"] for settings in methods.values())
    mean = results["active_rank"]["mean"] if rank is None else rank
    if mean > most:
        raise ValueError(f"the mean rank must be at most the run's {most}, got {mean:g}")
    budget = int(mean * sum(layers * (d_in + d_out) for layers, d_in, d_out in sizes.values()))
    planned = allocate(ranks, sizes, budget, most=most, least=least, drop=drop)
    rule = f"active rank, least {least}, drop {drop}"
    source = f"{run.resolve().name} {saved['sha256']}"
    return RankPlan(recorded.fields["backbone"], planned, source, rule, budget)


@functools.lru_cache(maxsize=1)  # a command plans, then counts
def shapes(config: BackboneConfig, layers: frozenset[str]) -> Shapes:
    """Return the shapes of the layers with these paths in a backbone."""
    model = nnx.eval_shape(lambda: config.create(nnx.Rngs(0)))
    return rules.shapes(model, [f"^{re.escape(path)}$" for path in layers])
