"""Measure a run on its held-out episodes while it trains, and keep its best adapters."""

from typing import Any

import jax
from flax import nnx
from safetensors.flax import load_file, save_file

from lorasp_jax.adapters import adaptation
from lorasp_jax.base.digest import digest
from lorasp_jax.base.files import as_value_error
from lorasp_jax.base.writing import atomic_file
from lorasp_jax.data.cache import Cache
from lorasp_jax.evaluation import held_out_figure
from lorasp_jax.evaluation.held_out import HeldOut, Windows, measure, table, windows
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training import records
from lorasp_jax.training.dataset import CACHE
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import VALIDATION, read_json, write_json

BEST, BEST_WEIGHTS = "best.json", "best.safetensors"
"""The best step and its error; its trainable parameters."""


class Validation(Callback):
    """Measures held-out episodes every `evaluation.validate_every` steps and after the last.

    It logs `HeldOut.scalars`. With `keep` "best", the policy with the least action error is the one
    that later callbacks evaluate and export; put this one before them. The measurements are
    repeatable, and the best adapters are on disk, so that a resumed run keeps what an uninterrupted
    one keeps.
    """

    def __init__(self) -> None:
        """Nothing is read before it is needed."""
        self._windows: Windows | None = None
        self._last: HeldOut | None = None

    def on_log(self, run: Run, step: int, metrics: dict[str, float]) -> dict[str, float]:  # noqa: ARG002
        """Measure the policy if it is due, and save its adapters if they are the best so far."""
        if not run.held_out or not run.config.validates(step):
            return {}
        self._last = self._measure(run)
        error = self._last.policy.mean
        run.console.print(
            f"held-out episodes at step {step}: action error {error:.3f}, holding still "
            f"{self._last.hold.mean:.3f} (standard deviations); loss {self._last.loss:.4f}"
        )
        best = read_json(run.folder / BEST, records.BEST)
        if run.config.keep == "best" and error < best.get("error", float("inf")):
            _save(run, step, error)
        return self._last.scalars

    def on_end(self, run: Run) -> None:
        """Take the best adapters; write validation.json and a picture per task."""
        if not run.held_out:
            return
        kept, last = run.config.optim.steps, self._last
        best = read_json(run.folder / BEST, records.BEST)
        if run.config.keep == "best" and best and best["step"] < kept:
            kept, run.policy = best["step"], _load(run, best)
            run.console.print(f"kept the adapters of step {kept}, the best on held-out episodes")
            last = None
        found = last or self._measure(run)
        content = {
            "episodes": [*run.held_out],
            "kept": kept,
            "errors": table(found),
            "horizon": found.policy.horizon.tolist(),
        }
        write_json(run.folder / VALIDATION, content)
        held_out_figure.write(run.folder, run.policy, Cache(run.folder / CACHE), run.held_out)

    def _measure(self, run: Run) -> HeldOut:
        with run.timed("validate"):
            if self._windows is None:
                self._windows = windows(Cache(run.folder / CACHE), run.held_out, run.policy)
            steps = run.config.evaluation.denoise_steps
            return measure(run.policy, self._windows, num_steps=steps)


def _save(run: Run, step: int, error: float) -> None:
    """Write the trainable parameters; a crash in between leaves the earlier ones or none."""
    leaves = _leaves(run.policy)
    (run.folder / BEST).unlink(missing_ok=True)
    with atomic_file(run.folder / BEST_WEIGHTS) as unfinished:
        save_file(leaves, unfinished)
    write_json(run.folder / BEST, {"step": step, "error": error, "weights": digest(leaves)})


def _load(run: Run, best: dict[str, Any]) -> Policy:
    """Return the run's policy with the best trainable parameters.

    Raises:
        ValueError: their file is missing or damaged.
    """
    path = run.folder / BEST_WEIGHTS
    with as_value_error(path, remedy=": add --keep last, or train again under another --name"):
        leaves = load_file(path)
        if digest(leaves) != best["weights"]:
            raise ValueError("its digest does not match")
    graphdef, adapters, frozen = adaptation.split(run.policy.model)
    names = [jax.tree_util.keystr(p) for p, _ in jax.tree_util.tree_leaves_with_path(adapters)]
    adapters = jax.tree.unflatten(jax.tree.structure(adapters), [leaves[name] for name in names])
    return Policy(nnx.merge(graphdef, adapters, frozen), run.policy.processor)


def _leaves(policy: Policy) -> dict[str, jax.Array]:
    adapters = adaptation.split(policy.model)[1]
    leaves = jax.tree_util.tree_leaves_with_path(adapters)
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
