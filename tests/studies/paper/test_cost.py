"""Cost of a cell: from the log, the shapes of a step and the adapters' arrays."""

import dataclasses

import pytest

from lorasp_jax.adapters import adaptation
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.run_folder import MetricsLog
from studies.paper.measures import cost
from tests.runs import CONFIG, make_run

BACKBONE = Pi0Config.dummy()


@pytest.mark.slow
def test_costs_of_a_run(tmp_path):
    log = MetricsLog(tmp_path)
    for step, rate in enumerate([10.0, 90.0, 100.04]):
        log.write(step, {"speed/samples_per_second": rate, "memory/peak_gib": 99.0})
    log.write(3, {"task": 1.0})
    log.close()
    config = dataclasses.replace(CONFIG, seed=5)
    found = cost.training_cost(tmp_path, config, BACKBONE)
    step = preflight.step_flops(CONFIG, BACKBONE)
    assert found["samples_per_second"] == 90.0
    assert found["flops_per_sample"] == step / CONFIG.optim.batch_size
    assert found["peak_bytes"] == round(preflight.estimate_memory(CONFIG, BACKBONE).peak)


@pytest.mark.slow
def test_without_a_log_there_is_no_speed(tmp_path):
    found = cost.training_cost(tmp_path, CONFIG, BACKBONE)
    assert found.keys() == {"flops_per_sample", "peak_bytes"}


@pytest.mark.slow
def test_seeds_share_the_counting(tmp_path, monkeypatch):
    cost.training_cost(tmp_path, CONFIG, BACKBONE)
    monkeypatch.setattr(preflight, "step_flops", None)
    other = dataclasses.replace(CONFIG, name="other", seed=1)
    assert cost.training_cost(tmp_path, other, BACKBONE)


def test_bytes_of_the_adapters(tmp_path):
    run = make_run(tmp_path / "run")
    assert cost.adapter_bytes(run.policy) == 4 * adaptation.count(run.policy.model).trainable
