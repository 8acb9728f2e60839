"""The command line: one sentence per mistake, typos suggest the right name."""

import re

import pytest

from envs.scene.ranges import Randomization
from lorasp_jax.config import Config
from lorasp_jax.models.presets import PRESETS
from lorasp_jax.peft import LoRA, LoRASP
from lorasp_jax.training.overrides import override, parse

CONFIG = Config(name="a", scale="cpu", peft=LoRASP(rank=8))
MULTITASK = ["--config", "configs/multitask.py"]


def test_dotted_overrides():
    changed = override(CONFIG, ["--peft.rank", "4", "--optim.steps=7", "--tasks", "press"])
    assert (changed.peft.rank, changed.optim.steps, changed.tasks) == (4, 7, ("press",))
    assert type(changed) is Config
    assert override(CONFIG, []) == CONFIG


def test_ranges():
    options = ["--scene.camera-position", "-0.05", "0.05", "--scene.mass", "1", "2"]
    ranges = override(CONFIG, options).scene
    assert ranges == Randomization(camera_position=(-0.05, 0.05), mass=(1, 2))
    assert override(CONFIG, options).ranges == ranges
    assert override(CONFIG, ["--scene.mass", "1", "1"]).ranges is None


def test_a_bool_is_negated():
    assert override(CONFIG, ["--evaluation.no-before"]).evaluation.before is False


def test_scale_is_chosen_by_backend_and_can_be_forced():
    assert parse(MULTITASK).config.scale == "cpu"
    assert parse([*MULTITASK, "--scale", "accelerator"]).config.model.size == "small"


def test_method_by_name_keeps_the_rank():
    command = parse([*MULTITASK, "--method", "lora", "--resume", "--peft.alpha", "7"])
    config = command.config
    assert isinstance(config.peft, LoRA)
    assert config.peft.rank == parse(MULTITASK).config.peft.rank
    assert config.peft.alpha == 7
    assert command.resume is True
    assert not command.dry_run
    for auto in (["--resume", "auto"], ["--resume=auto"]):
        assert parse([*MULTITASK, *auto, "--method", "lora"]).resume == "auto"
    assert parse(MULTITASK).resume is False


def test_fit_knows_which_settings_are_given():
    command = parse(
        [*MULTITASK, "--fit", "16GB", "--model.base-dtype=nf4", "--optim.accumulate", "2"]
    )
    assert command.fit == "16GB"
    assert command.given == {"model.base_dtype", "optim.accumulate"}
    assert parse(MULTITASK).fit is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--config", "configs/multitusk.py"], "configs/multitusk.py does not exist: .*multitask"),
        ([], "--config is required"),
        (["--confg", "configs/multitask.py"], "--config is required"),
        ([*MULTITASK, "--method", "lorra"], "lorra.*lora_sp"),
        ([*MULTITASK, "--dry-run", "--resume"], "cannot be combined"),
        ([*MULTITASK, "--data.source=mine", "--tasks", "fold"], "decides them: drop it"),
        ([*MULTITASK, "--resume", "always"], "--resume: invalid choice: 'always'.*auto"),
    ],
)
def test_mistakes_are_one_sentence(arguments, message, capsys):
    with pytest.raises(ValueError, match=message) as caught:
        parse(arguments)
    text = str(caught.value)
    assert "\n" not in text
    assert "Traceback" not in text + capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--tasks"], "tasks must be non-empty and unique"),
        (["--peft.rnk", "4"], "Unrecognized options: --peft.rnk, 4 .* --peft.rank INT"),
        (["--dry-runn"], "Unrecognized options: --dry-runn"),
        (["--optim.steps", "many"], "--optim.steps: .*'many'"),
        (["--peft.energy-target", "1.5"], "peft: energy_target must lie in .* got 1.5"),
    ],
)
def test_mistakes_in_fields_are_explained(arguments, message, capsys):
    with pytest.raises(SystemExit) as caught:
        parse([*MULTITASK, *arguments])
    assert caught.value.code == 2
    printed = " ".join(re.sub("[│╭╮╰╯─]", " ", capsys.readouterr().err).split())
    assert re.search(message, printed)


@pytest.mark.parametrize("config", [[], MULTITASK])
def test_help_lists_every_field_and_option(config, capsys):
    with pytest.raises(SystemExit) as caught:
        parse([*config, "--help"])
    assert caught.value.code == 0
    printed = capsys.readouterr().out
    for name in (
        "--peft.energy-target",
        "--optim.learning-rate",
        "--evaluation.episodes",
    ):
        assert name in printed
    for name in ("--config", "--method", "--resume", "--dry-run"):
        assert name in printed
    words = " ".join(printed.replace("│", " ").split())
    assert "--optim.b2 FLOAT Decay of the second moment. (default: 0.95)" in words
    assert "lora_sp, lora_sp_release (default: the experiment's, lora_sp)" in words
    assert printed.count("--scale SCALE") == 1
    assert "--scale STR" not in printed
    assert f"presets ({', '.join(PRESETS)}) and regular expressions" in words


@pytest.mark.parametrize("arguments", [["--robot", "-h"], ["--peft.rank", "x", "--help"]])
def test_help_in_place_of_a_value(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        parse([*MULTITASK, *arguments])
    assert caught.value.code in (0, None)
    printed = capsys.readouterr()
    assert "--optim.learning-rate" in printed.out
    assert not printed.err
