"""Measure the deployment variants of a finished run, and record them in its deployment.json."""

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import envs
from envs.datasets.episodes import Episodes
from envs.scene.ranges import Randomization
from lorasp_jax.adapters import adaptation
from lorasp_jax.config import Config, DataConfig
from lorasp_jax.data.batches import Batch
from lorasp_jax.evaluation import metrics, results
from lorasp_jax.evaluation.callback import success
from lorasp_jax.evaluation.intervals import wilson_interval
from lorasp_jax.evaluation.programs import split_rollout
from lorasp_jax.extras.deployment import variants
from lorasp_jax.extras.deployment.variants import BATCH_SIZE, BATCHES, Variant
from lorasp_jax.extras.study import cost, held_out, statistics
from lorasp_jax.peft import LoRASP
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training import export, records
from lorasp_jax.training.demonstrations import fresh_demonstrations
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run_folder import CONFIG_FILE, read_json, recorded_ranges, write_json

FILE = "deployment.json"
WHOLE = Variant("whole", "bf16")
"""The variant that others are compared with."""
_CONFIG: records.Schema = records.CONFIG | {
    "image_size": int,
    "control_dt": float,
    "seed": int,
    "data": {"num_envs": int, "action_noise": float},
    "evaluation": {"episodes": int, "num_envs": int, "execute_steps": int, "denoise_steps": int},
}

_environment = functools.cache(envs.make)
"""Shared by all variants: an environment's programs are compiled for the object."""

Evaluate = Callable[[Policy, dict[str, Any], str, int], dict[str, Any]]
"""Signature of `evaluate`."""


def load(run: Path) -> tuple[Policy, dict[str, Any], Config]:
    """Return a run's policy, its recorded config, and the config of held-out demonstrations.

    Raises:
        ValueError: the run is not finished, has another method than LoRA-SP, or cannot be
            simulated.
    """
    policy = export.load_policy(run)
    methods = {*adaptation.methods(policy.model).values()}
    if not methods or not all(map(variants.is_bank, methods)):
        names = ", ".join(sorted({type(m).__name__ for m in methods})) or "full fine-tuning"
        raise ValueError(f"{run} was trained with {names}: only LoRA-SP runs have variants")
    config = read_json(run / CONFIG_FILE, _CONFIG)
    finished = read_json(run / "results.json", records.RESULTS)
    if not config or not finished:
        raise ValueError(f"{run} is not a finished run: it needs {CONFIG_FILE} and results.json")
    if not finished["tasks"]:
        raise ValueError(f"the tasks of {run} cannot be simulated")
    data = {name: config["data"][name] for name in ("num_envs", "action_noise")}
    # Only what the demonstrations depend on.
    recorded = Config(
        name=config["name"],
        scale=config["scale"],
        peft=LoRASP(),
        robot=config["robot"],
        tasks=tuple(finished["tasks"]),
        image_size=config["image_size"],
        control_dt=config["control_dt"],
        seed=config["seed"],
        scene=recorded_ranges(config) or Randomization(),
        data=DataConfig(episodes=held_out.EPISODES, **data),
    )
    return policy, config, held_out.settings(recorded)


def calibration_episodes(settings: Config) -> dict[str, Episodes]:
    """Collect the demonstrations on which adapters are pruned and distilled."""
    return fresh_demonstrations(settings, 1)


def loss_episodes(settings: Config) -> dict[str, Episodes]:
    """Collect the demonstrations on which losses are measured."""
    return fresh_demonstrations(settings, 2)


def evaluate(policy: Policy, config: dict[str, Any], task: str, episodes: int) -> dict[str, Any]:
    """Return success as in results.json, on the layouts of the run's final evaluation."""
    recorded = config["evaluation"]
    env = _environment(
        task,
        robot=config["robot"],
        num_envs=min(episodes, recorded["num_envs"]),
        image_size=config["image_size"],
        control_dt=config["control_dt"],
    )
    steps = {name: recorded[name] for name in ("execute_steps", "denoise_steps")}
    rollout = split_rollout(env, ranges=recorded_ranges(config), **steps)
    key = RandomStream.FINAL_EVALUATION.key(config["seed"], task)
    return success(results.evaluate(policy, env, key, episodes, rollout=rollout))


def measure(
    run: Path,
    names: Sequence[str] = (),
    episodes: int = 0,
    *,
    evaluate: Evaluate = evaluate,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Measure variants on the same layouts; write deployment.json after each.

    Args:
        run: folder of a finished LoRA-SP run.
        names: variants; none: all. `WHOLE` is always measured.
        episodes: episodes per task; 0: as many as in the run's evaluation.
        evaluate: measures success on one task.
        progress: called with the name of each variant.

    Returns:
        The content of deployment.json: `episodes` per task, and `variants` by name, each with
        `tasks` as in results.json, `success` [mean over tasks, low, high], the paired `difference`
        to `WHOLE` [value, low, high], `loss` on held-out demonstrations, `bytes` of all weights,
        and `milliseconds` of one policy call.

    Raises:
        ValueError: see `load`; a variant is unknown, the number of episodes does not fit, or
            success depends on an episode's position in its batch.
    """
    chosen = [WHOLE, *(v for v in map(variants.find, names or variants.VARIANTS) if v != WHOLE)]
    policy, config, settings = load(run)
    episodes = episodes or config["evaluation"]["episodes"]
    calibration, held = calibration_episodes(settings), loss_episodes(settings)
    found: dict[str, Any] = {"episodes": episodes, "machine": _machine(), "variants": {}}
    forms: dict[str, Policy] = {}
    for variant in chosen:
        progress(str(variant))
        if variant.form not in forms:
            forms = {variant.form: variants.in_form(policy, variant.form, calibration)}
        deployed = variants.on_base(forms[variant.form], variant.base)
        tasks = {task: evaluate(deployed, config, task, episodes) for task in settings.tasks}
        if bias := metrics.position_bias([o == "1" for o in r["outcomes"]] for r in tasks.values()):
            raise ValueError(bias)
        whole = tasks if variant == WHOLE else found["variants"][str(WHOLE)]["tasks"]
        found["variants"][str(variant)] = {
            "tasks": tasks,
            **compared(tasks, whole),
            "loss": mean_loss(deployed, held),
            "bytes": weight_bytes(deployed),
            "milliseconds": cost.call_milliseconds(deployed, next(iter(held.values()))),
        }
        write_json(run / FILE, found)
    return found


def compared(tasks: Mapping[str, Any], whole: Mapping[str, Any]) -> dict[str, list[float]]:
    """Return a variant's success, averaged over tasks, and its paired difference to another one.

    Success has a Wilson interval over all episodes, since that of resampling is empty at 100 %.
    """
    both = [
        statistics.outcomes([[{"outcomes": {t: r["outcomes"] for t, r in each.items()}}]])
        for each in (tasks, whole)
    ]
    low, high = wilson_interval(int(both[0].sum()), both[0].size)
    return {
        "success": [float(both[0].mean()), low, high],
        "difference": list(statistics.difference(*both)),
    }


def mean_loss(policy: Policy, episodes: Mapping[str, Episodes]) -> float:
    """Return the flow-matching loss, averaged over valid action elements, then over tasks."""
    by_task = held_out.keyed_batches(policy, episodes, BATCH_SIZE, BATCHES)
    losses = [_loss(policy.model, pair) for pairs in by_task.values() for pair in pairs]
    return float(jnp.stack(losses).mean())


@jax.jit
def _loss(model: Any, keyed: tuple[jax.Array, Batch]) -> jax.Array:
    per_element, _ = variants.forward(model, keyed)
    mask = keyed[1].action_mask
    return jnp.where(mask, per_element, 0).sum() / mask.sum()


def weight_bytes(policy: Policy) -> int:
    """Return the size of a policy's weights [bytes]: base, codes and scales, adapters."""
    return sum(leaf.nbytes for leaf in jax.tree.leaves(policy.model) if hasattr(leaf, "nbytes"))


def _machine() -> str:
    return f"{jax.devices()[0].device_kind}, jax {jax.__version__}"


def table(found: Mapping[str, Any]) -> str:
    """Return the content of deployment.json as a Markdown table."""
    lines = [
        "| variant | success | difference to whole | held-out loss | weights | policy call |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in found["variants"].items():
        rate, low, high = (100 * value for value in row["success"])
        change, least, most = (100 * value for value in row["difference"])
        difference = f"{change:+.1f} ({least:+.1f} to {most:+.1f})"
        if name == str(WHOLE):
            difference = ""
        lines.append(
            f"| {name} | {rate:.1f} % ({low:.0f} to {high:.0f}) | {difference} | "
            f"{row['loss']:.4f} | {row['bytes'] / 1e6:.2f} MB | {row['milliseconds']:.1f} ms |"
        )
    return "\n".join(lines) + "\n"
