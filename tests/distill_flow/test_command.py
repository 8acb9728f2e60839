"""What a start run decides, what is refused, and that a run trains what it should and resumes."""

import dataclasses
import io
import re
import shutil

import numpy as np
import pytest
from rich.console import Console

from lorasp_jax.adapters import adaptation
from lorasp_jax.cli.train import _resolved
from lorasp_jax.config import EvaluationConfig
from lorasp_jax.distill_flow import command
from lorasp_jax.distill_flow.config import Distillation, DistillFlowConfig
from lorasp_jax.distill_flow.objectives import Endpoint, SnapFlow, of
from lorasp_jax.peft import AdaLoRA, LoRA
from lorasp_jax.training import export, loop
from lorasp_jax.training.export import BASE, load_policy
from lorasp_jax.training.finished_run import recorded_config
from lorasp_jax.training.overrides import parse
from lorasp_jax.training.run_folder import read_json, to_json, write_json
from tests import ROOT, runs
from tests.runs import CONFIG, RESULTS, Terminate, finish_with_weights, leaves, make_run, repeatable

FILE = str(ROOT / "configs/distill_flow.py")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return finish_with_weights(tmp_path_factory.mktemp("runs") / "start")


def resolve(*arguments) -> DistillFlowConfig:
    options = ["--config", FILE, "--scale", "smoke", *map(str, arguments)]
    config = _resolved(parse(options)).config
    assert isinstance(config, DistillFlowConfig)
    return config


def test_the_start_run_decides(finished):
    config, recorded = resolve("--from", finished), recorded_config(finished)
    for name in ("model", "robot", "tasks", "peft", "targets", "data", "seed"):
        assert getattr(config, name) == getattr(recorded, name), name
    assert config.optim.learning_rate == pytest.approx(0.3 * recorded.optim.learning_rate)
    assert config.optim.batch_size == recorded.optim.batch_size
    chosen = resolve("--from", finished, "--optim.learning-rate", 1e-4, "--optim.batch-size=16")
    assert (chosen.optim.learning_rate, chosen.optim.batch_size) == (1e-4, 16)


def test_the_config_names_the_objective(finished):
    assert of(resolve("--from", finished)) == Endpoint(2)
    one = ("--evaluation.denoise-steps", 1)
    assert of(resolve("--from", finished, *one)) == Endpoint(1)
    assert of(resolve("--from", finished, *one, "--distill.loss", "snapflow")) == SnapFlow()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--from", ""], "needs a finished run: name it with --from"),
        (["--robot", "panda"], "--robot is that of .*start \\(piper\\): drop it"),
        (["--tasks", "pour"], "--tasks is that of .*start: drop it"),
        (["--evaluation.denoise-steps", 10], "must be below 10, the flow steps that are distilled"),
        (["--distill.loss", "snapflow"], "snapflow learns one flow step: .* is 2"),
        (["--optim.rtc-max-delay", 2], "optim.rtc_max_delay is not for flow distillation"),
        (["--dry-run"], "--dry-run is not for flow distillation: drop it"),
    ],
)
def test_bad_input_is_refused_in_a_sentence(finished, arguments, message, capsys):
    with pytest.raises((ValueError, SystemExit)) as caught:
        resolve("--from", finished, *arguments)
    said = str(caught.value) + re.sub(r"[│\s]+", " ", capsys.readouterr().err)
    assert re.search(message, said), said


def test_runs_that_cannot_be_distilled_are_refused(finished, tmp_path):
    config = recorded_config(finished)
    write_json(tmp_path / "config.json", to_json(config))
    with pytest.raises(ValueError, match="is not a finished run"):
        resolve("--from", tmp_path)
    full = shutil.copytree(finished, tmp_path / "full")
    shutil.copytree(finished.parent / "base", full / BASE)
    metadata = read_json(full / "adapter.json")["metadata"]
    write_json(full / BASE / "training.json", metadata)
    with pytest.raises(ValueError, match="full has no adapters, it trained its base"):
        resolve("--from", full)
    twice = shutil.copytree(finished, tmp_path / "twice")
    write_json(twice / "config.json", to_json(resolve("--from", finished)))
    with pytest.raises(ValueError, match="twice is distilled already"):
        resolve("--from", twice)


def test_a_run_of_recordings_is_distilled_though_it_has_no_success(finished, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "recorded")
    write_json(folder / "results.json", RESULTS | {"tasks": {}})
    assert resolve("--from", folder).tasks == recorded_config(finished).tasks


def distilling(folder, **changes):
    """A run that distills the random policy of a tiny model to one step, with averages."""
    fields = {field.name: getattr(CONFIG, field.name) for field in dataclasses.fields(CONFIG)}
    optim = dataclasses.replace(CONFIG.optim, ema=0.5, weight_decay=0.1, accumulate=2)
    fields |= {"peft": LoRA(rank=4), "optim": optim, "keep": "last"}
    fields |= {"evaluation": EvaluationConfig(denoise_steps=1), "distill": Distillation()}
    run = make_run(folder, DistillFlowConfig(**fields | changes))
    run.console, run.programs = Console(file=io.StringIO()), runs.PROGRAMS
    return command.student(run)


def test_it_trains_the_action_expert_alone_and_resumes_to_the_bit(tmp_path):
    whole, halved = distilling(tmp_path / "whole"), distilling(tmp_path / "halved")
    before = leaves(adaptation.split(whole.policy.model)[1])
    flow = leaves(whole.split()[1])
    assert whole.parameters[0] == sum(x.size for x in flow.values())
    loop.train(whole)
    with pytest.raises(KeyboardInterrupt):
        loop.train(halved, [Terminate()])
    halved = distilling(tmp_path / "halved")  # as in a new process
    loop.train(halved, resume=True)
    assert repeatable(whole.folder) == repeatable(halved.folder)
    after, resumed = (leaves(adaptation.split(x.policy.model)[1]) for x in (whole, halved))
    assert after.keys() == before.keys() > flow.keys()
    for name, value in after.items():
        np.testing.assert_array_equal(value, resumed[name], err_msg=name)
        assert (value != before[name]).any() == (name in flow), name


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"targets": ("^vision",)}, "has no adapters in the action expert"),
        ({"peft": AdaLoRA(rank=2)}, "ada_lora's rank budget spans all layers"),
    ],
)
def test_policies_that_cannot_be_distilled_are_refused(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        distilling(tmp_path / "run", **changes)


def test_the_distilled_policy_is_exported_with_its_steps(finished, tmp_path, monkeypatch):
    config = dataclasses.replace(resolve("--from", finished), name="run")
    made = make_run(tmp_path / "run", config)
    made.base_hash = read_json(finished / "adapter.json")["base"]
    monkeypatch.setattr(command.setup, "prepare", lambda *_, **__: made)
    run = command.prepare(config, made.folder, made.console, 0.0)
    old = leaves(adaptation.split(load_policy(finished).model)[1])
    assert all((x == old[name]).all() for name, x in leaves(run.split()[1]).items())
    command.DistilledExport().on_end(run)
    write_json(made.folder / "config.json", to_json(config))
    assert export.denoise_steps(made.folder) == 2
    again = leaves(adaptation.split(load_policy(made.folder).model)[1])
    assert all((again[name] == x).all() for name, x in old.items())
    prompts = dataclasses.replace(made.policy.processor.prompts, instructions=("other",))
    inputs = dataclasses.replace(made.policy.processor, prompts=prompts)
    made.policy = dataclasses.replace(made.policy, processor=inputs)
    with pytest.raises(ValueError, match="the instructions of the data are not those that"):
        command.prepare(config, made.folder, made.console, 0.0)


def test_configs_files_load():
    for scale in ("smoke", "cpu", "accelerator"):
        assert parse(["--config", FILE, "--scale", scale]).config.evaluation.denoise_steps == 2
