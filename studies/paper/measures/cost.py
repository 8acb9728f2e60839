"""What training costs: speed, FLOPs and memory; and the size of adapters."""

import dataclasses
import functools
import statistics
from pathlib import Path

import jax
from flax import nnx

from lorasp_jax.config import Config
from lorasp_jax.dense import AdapterParam
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.run_folder import read_metrics


def training_cost(folder: Path, config: Config, backbone: BackboneConfig) -> dict[str, float]:
    """Return what training cost, as recorded under "speed".

    - `samples_per_second`: median over log intervals; absent if nothing was logged.
    - `flops_per_sample`: of the matrix products of a training step, without recomputation.
    - `peak_bytes`: estimate of `training.cost.preflight` for a device. The peak that a device
      reports covers its whole process: evaluation, and all cells that ran before.

    Args:
        folder: the run's folder.
        config: the run's config.
        backbone: the config of the run's model, with the chosen rematerialization.
    """
    rate = "speed/samples_per_second"
    rates = [row[rate] for row in read_metrics(folder) if rate in row]
    speed = {"samples_per_second": round(statistics.median(rates), 1)} if rates else {}
    # Runs that differ only by name and seed cost the same.
    return speed | _step_cost(dataclasses.replace(config, name="any", seed=0), backbone)


@functools.lru_cache(maxsize=64)
def _step_cost(config: Config, backbone: BackboneConfig) -> dict[str, float]:
    """Return FLOPs per sample and estimated peak memory of a training step."""
    return {
        "flops_per_sample": preflight.step_flops(config, backbone) / config.optim.batch_size,
        "peak_bytes": round(preflight.estimate_memory(config, backbone).peak),
    }


def adapter_bytes(policy: Policy) -> int:
    """Return the size of a policy's adapters [bytes]."""
    return sum(leaf.nbytes for leaf in jax.tree.leaves(nnx.state(policy.model, AdapterParam)))
