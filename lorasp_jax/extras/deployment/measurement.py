"""Compare the deployment variants of a finished run: each is a cell of a study."""

import dataclasses
import functools
import statistics as medians
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import lorasp_jax
from lorasp_jax.base.intervals import wilson_interval
from lorasp_jax.extras.deployment import variants
from lorasp_jax.extras.deployment.variants import BATCH_SIZE, BATCHES, VARIANTS, WHOLE
from lorasp_jax.extras.study import Derived, held_out, page, statistics
from lorasp_jax.extras.study.statistics import Estimate
from lorasp_jax.extras.study.study import Results, evaluated
from lorasp_jax.training import fixed_batches
from lorasp_jax.training.demonstrations import Demonstrations, fresh_demonstrations
from lorasp_jax.training.fixed_batches import Keyed
from lorasp_jax.training.run import Run

CALLS = 20
"""Number of timed calls."""


def cells(
    run: Path,
    episodes: int = 0,
    prefix: str = "",
    tasks: tuple[str, ...] = (),
    names: Sequence[str] = VARIANTS,
) -> tuple[Derived, ...]:
    """Return a cell for each variant of a run, evaluated on the same layouts.

    Args:
        run: folder of a finished run.
        episodes: episodes per task; 0: as many as in the run's evaluation.
        prefix: what the names of the cells begin with, before those of the variants.
        tasks: of the run on which to calibrate and evaluate; (): all.
        names: of the variants.
    """
    config = functools.partial(evaluated, tasks=tasks, episodes=episodes)

    def transform(name: str) -> Any:
        return lambda policy, _, held: variants.transform(name, policy, held)

    return tuple(Derived(prefix + n, run, transform(n), config=config) for n in names)


def measure(run: Run, _: Demonstrations, __: lorasp_jax.policies.Policy | None) -> dict[str, Any]:
    """Return the measures of a variant.

    `loss` on demonstrations that did not calibrate it, `bytes` of all weights, `milliseconds` of
    one policy call, and the `machine` that measured them.
    """
    settings = held_out.settings(run.config)
    # Its seed and name change no demonstration.
    episodes = _other_demonstrations(dataclasses.replace(settings, name="any"), 1)
    return {
        "measures": {
            "loss": mean_loss(run.policy, episodes),
            "bytes": weight_bytes(run.policy),
            "milliseconds": call_milliseconds(
                run.policy, episodes, run.config.evaluation.denoise_steps
            ),
            "machine": f"{jax.devices()[0].device_kind}, jax {jax.__version__}",
        }
    }


_other_demonstrations = functools.lru_cache(maxsize=1)(fresh_demonstrations)


def mean_loss(policy: lorasp_jax.policies.Policy, episodes: Demonstrations) -> float:
    """Return the flow-matching loss, averaged over valid action elements, then over tasks."""
    by_task = fixed_batches.keyed_batches(policy, episodes, BATCH_SIZE, BATCHES)
    losses = [_loss(policy.model, pair) for pairs in by_task.values() for pair in pairs]
    return float(jnp.stack(losses).mean())


@jax.jit
def _loss(model: Any, keyed: Keyed) -> jax.Array:
    per_element, _ = fixed_batches.forward(model, keyed)
    mask = keyed[1].action_mask
    return jnp.where(mask, per_element, 0).sum() / mask.sum()


def weight_bytes(policy: lorasp_jax.policies.Policy) -> int:
    """Return the size of a policy's weights [bytes]: base, codes and scales, adapters."""
    return sum(leaf.nbytes for leaf in jax.tree.leaves(policy.model) if hasattr(leaf, "nbytes"))


def call_milliseconds(
    policy: lorasp_jax.policies.Policy, episodes: Demonstrations, num_steps: int
) -> float:
    """Return the median time to sample one action chunk from one observation [ms]."""
    policy, first = policy.with_sampler(), next(iter(episodes.values()))
    images = {name: jnp.asarray(image[0, :1]) for name, image in first.image.items()}
    observation = {"image": images, "state": jnp.asarray(first.state[0, :1])}
    row = jnp.array(policy.processor.prompts.rows(first.phrases[:1]))
    sample = functools.partial(_sample, num_steps=num_steps)
    arguments = policy, jax.random.key(0), observation, row
    jax.block_until_ready(sample(*arguments))  # compiles
    times = []
    for _ in range(CALLS):
        start = time.perf_counter()
        jax.block_until_ready(sample(*arguments))
        times.append(time.perf_counter() - start)
    return 1000 * medians.median(times)


_sample = jax.jit(
    lambda policy, *arguments, num_steps: policy.sample(*arguments, num_steps=num_steps),
    static_argnames="num_steps",
)


def table(results: Results, prefix: str = "") -> str:
    """Return the variants whose names begin with `prefix` as a Markdown table.

    Success, averaged over tasks, has a Wilson interval over all episodes, since that of resampling
    is empty at 100 %; its difference to `WHOLE` is paired.
    """
    whole, rows = statistics.stacked([results[prefix + WHOLE]["outcomes"]]), []
    for name in (name for name in VARIANTS if prefix + name in results):
        found = results[prefix + name]
        outcomes, measures = statistics.stacked([found["outcomes"]]), found["measures"]
        bounds = wilson_interval(int(outcomes.sum()), outcomes.size)
        success = page.percent(Estimate(float(outcomes.mean()), *bounds))
        difference = page.difference(outcomes, whole)
        weights, loss = measures["bytes"] / 1e6, measures["loss"]
        cells = [f"{loss:.4f}", f"{weights:.2f} MB", f"{measures['milliseconds']:.1f} ms"]
        rows.append([name, success, difference if name != WHOLE else "", *cells])
    titles = ["success [%]", "minus whole", "held-out loss", "weights", "policy call"]
    return page.table(["variant", *titles], rows)
