"""What an iteration of learning from success takes: seconds and rates of its parts, and memory.

    python -m benchmarks.reinforce --backbone pi0 --size small --task pick_place --worlds 256

From random adapters: what a policy does makes no difference, since worlds run until the time limit.
The first call of a part compiles it, unless JAX_COMPILATION_CACHE_DIR has its programs.
"""

import argparse
import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import numpy as np
from rich.console import Console

from benchmarks import measuring
from lorasp_jax.base import compilation_cache as cache
from lorasp_jax.config import ModelConfig
from lorasp_jax.peft import LoRA
from lorasp_jax.reinforce import student, teacher
from lorasp_jax.reinforce.config import ReinforceConfig
from lorasp_jax.reinforce.setting import Setting, prepare
from lorasp_jax.training import setup
from lorasp_jax.training.overrides import load

CONFIG = Path(__file__).parents[1] / "configs" / "reinforce.py"


def main() -> None:
    """Parse arguments, measure, print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scale", default="accelerator")
    parser.add_argument("--backbone", default="pi0")
    parser.add_argument("--size", default="small")
    parser.add_argument(
        "--checkpoint", default=ModelConfig.checkpoint, help="empty: random weights"
    )
    parser.add_argument("--task", default="pick_place")
    parser.add_argument("--worlds", type=int, default=256)
    parser.add_argument("--batch", type=int, default=128)
    parser.add_argument("--steps", type=int, default=100, help="gradient steps")
    options, console = parser.parse_args(), Console()
    cache.enable()
    config = load(CONFIG, options.scale)
    assert isinstance(config, ReinforceConfig)
    names = {name: getattr(options, name) for name in ("backbone", "size", "checkpoint")}
    learning = dataclasses.replace(
        config.online, worlds=options.worlds, gradient_steps=options.steps
    )
    config = dataclasses.replace(
        config,
        peft=LoRA(rank=64),
        model=ModelConfig(dtype="bfloat16", **names),
        tasks=(options.task,),
        data=dataclasses.replace(config.data, episodes=16),  # for the normalization
        optim=dataclasses.replace(config.optim, batch_size=options.batch),
        online=learning,
    )
    with TemporaryDirectory() as folder:
        run = setup.prepare(config, Path(folder), console, time.perf_counter())
        setting, state, _ = prepare(run)
        rows = measure(setting, state)
    title = f"{measuring.machine('jax')}, {options.backbone} {options.size}"
    measuring.print_table(console, rows, title)
    peak = (jax.local_devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0)
    console.print(f"peak memory {peak / 2**30:.1f} GiB")


def measure(setting: Setting, state: Any) -> list[dict[str, Any]]:
    """Return a row per part: times, and control steps or samples per second."""
    (task,), config = setting.environments, setting.config
    learning, key = config.online, jax.random.key(0)
    policy = setting.policy(state.adapters).with_sampler()
    env, gym = setting.environments[task], setting.gyms[task]
    steps = env.max_steps * env.num_envs
    seen, times = _timed(lambda: setting.collect(task, policy, key, std=0.0))
    rows = [_row("policy, pictures, physics", steps, times)]
    own, critic = state.teachers[task], state.critics[task]
    _, times = _timed(lambda: teacher.practise(own, critic, gym, policy, key, learning))
    rows.append(_row("teacher, physics", gym.max_steps * gym.num_envs, times))
    lessons = student.lessons(seen, own, policy.processor)
    size, count = config.optim.batch_size, len(lessons.prompts)
    index = student.order(count, learning.gradient_steps, size, key)
    current = [state]

    def imitate() -> Any:
        current[0], metrics = setting.imitate(current[0], setting.frozen, lessons, index, key)
        return metrics

    _, times = _timed(imitate)
    rows.append(_row("gradient steps", np.size(index), times))
    return rows


def _row(part: str, count: int, times: Sequence[float]) -> dict[str, Any]:
    first, seconds, cores = times
    return {
        "part": part,
        "first call [s]": first,
        "its CPU time [s]": cores,
        "seconds": seconds,
        "per s": count / seconds,
    }


def _timed(call: Callable[[], Any]) -> tuple[Any, tuple[float, float, float]]:
    """Return the result of a call, the seconds of a first and a second one, and the first's CPU."""
    started, used = time.perf_counter(), time.process_time()
    jax.block_until_ready(call())
    compiled, used = time.perf_counter(), time.process_time() - used
    result = jax.block_until_ready(call())
    return result, (compiled - started, time.perf_counter() - compiled, used)


if __name__ == "__main__":
    main()
