"""Every method trains in the same loop, including its own additions to the step."""

import dataclasses

import numpy as np
import optax
import pytest

from lorasp_jax import peft
from lorasp_jax.adapters import adaptation
from lorasp_jax.config import OptimConfig
from lorasp_jax.training.loop import train
from lorasp_jax.training.optim import make_optimizer
from lorasp_jax.training.run_folder import read_metrics
from tests.runs import CONFIG, Terminate, leaves, make_run

SMALL = {"rank": 8, "target_rank": 3, "interval": 1, "hidden_width": 8, "experts": 2}
COVERED = ("lora_sp",)  # by the other tests of the loop


def configure(name, **changes):
    fields = {field.name for field in dataclasses.fields(peft.find(name))}
    method = peft.create(name, **{key: value for key, value in SMALL.items() if key in fields})
    optim = dataclasses.replace(CONFIG.optim, **changes)
    return dataclasses.replace(CONFIG, peft=method, optim=optim, targets=("q_proj",))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in peft.names() if name not in COVERED])
def test_trains(name, tmp_path):
    run = make_run(tmp_path / "run", configure(name))
    _, before, frozen_before = adaptation.split(run.policy.model)
    train(run)
    _, after, frozen = adaptation.split(run.policy.model)
    for key, value in leaves(frozen).items():
        np.testing.assert_array_equal(value, leaves(frozen_before)[key], err_msg=key)
    assert all((v != leaves(before)[key]).any() for key, v in leaves(after).items())
    assert all(np.isfinite(row["loss"]) for row in read_metrics(run.folder))


@pytest.mark.slow
def test_the_rank_budget_holds_in_the_loop_and_after_a_resume(tmp_path):
    config = configure("ada_lora", steps=6)
    whole, halved = make_run(tmp_path / "whole", config), make_run(tmp_path / "halved", config)
    train(whole)
    with pytest.raises(KeyboardInterrupt):
        train(halved, [Terminate()])
    halved = make_run(tmp_path / "halved", config)  # as in a new process
    train(halved, resume=True)

    _, adapters, _ = adaptation.split(whole.policy.model)
    _, resumed, _ = adaptation.split(halved.policy.model)
    for key, value in leaves(resumed).items():
        np.testing.assert_array_equal(value, leaves(adapters)[key], err_msg=key)
    entries = [value for key, value in leaves(adapters).items() if "lora_e" in key]
    assert len(entries) == len(adaptation.methods(whole.policy.model)) > 1
    nonzero, budget = sum((e != 0).sum() for e in entries), sum(e.size for e in entries) * 3 / 8
    assert budget - 4 < nonzero <= budget  # ties at the threshold are pruned
    assert read_metrics(whole.folder)[-1]["orthogonality"] > 0


def test_ada_lora_layers_need_the_same_settings():
    one, other = peft.AdaLoRA(target_rank=8), peft.AdaLoRA(target_rank=4)
    with pytest.raises(ValueError, match="must have the same settings, got 2 different"):
        make_optimizer(OptimConfig(), [one, peft.LoRA(), other])
    make_optimizer(OptimConfig(), [one, one, peft.LoRA()])
    assert isinstance(make_optimizer(OptimConfig()), optax.GradientTransformation)
