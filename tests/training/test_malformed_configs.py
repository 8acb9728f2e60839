"""Invalid options and experiment files: one-line errors, see `tests.test_malformed`."""

from pathlib import Path

import pytest

from lorasp_jax.training.overrides import parse
from tests import ROOT
from tests.malformed import check_refusal

OPTIONS = {
    "optim.steps": ["many", "3000000000", "0", "-3", "1.5", "", "nan", None],
    "optim.learning-rate": ["fast", "-1", "nan", "inf", None],
    "optim.warmup-steps": ["-1"],
    "optim.weight-decay": ["-0.1", "nan"],
    "optim.b2": ["1", "-0.1", "nan"],
    "optim.clip-norm": ["0", "nan"],
    "optim.accumulate": ["0"],
    "optim.ema": ["1", "-1", "nan"],
    "optim.spike": ["0.5", "inf"],
    "optim.max-skipped": ["0"],
    "optim.rtc-max-delay": ["-1", "1.5"],
    "optim.stepz": ["3"],
    "auxiliary.spectral": ["-1", "nan"],
    "auxiliary.warmup": ["2"],
    "data.episodes": ["0", "x"],
    "data.action-noise": ["-1", "inf"],
    "evaluation.every": ["-1"],
    "evaluation.execute-steps": ["0"],
    "model.dtype": ["float64"],
    "model.max-tokens": ["-1"],
    "model.chunk": ["-1"],
    "model.unroll": ["maybe"],
    "model.remat": ["all"],
    "peft.rank": ["99999999999999999999999", "0", "x", "2.5", None],
    "peft.alpha": ["nan", "x", "1e300"],
    "peft.energy-target": ["0", "1.5", "nan"],
    "peft.score-function": ["x"],
    "control-dt": ["0", "-0.1", "nan"],
    "scene.mass": ["1", "x", "nan", None],
    "scene.wind": ["0"],
    "seed": ["-1", "99999999999", "x"],
    "image-size": ["0"],
    "name": ["", ".", "..", "/tmp/x", "a/b", "a/", "a\nb", "a\udcff", "n" * 201, "ä" * 101],
    "checkpoint-every": ["0"],
    "scale": ["gpu", None],
    "method": ["lorra", None],
    "config": ["nowhere.py", "n" * 300, "--", None],
    "nme": ["x"],
}
MULTITASK = ["--config", str(ROOT / "configs" / "multitask.py"), "--scale", "smoke"]
CHOICES = [(f"--{name}", value) for name, values in OPTIONS.items() for value in values]


@pytest.mark.parametrize(("option", "value"), CHOICES)
def test_invalid_options_are_rejected(
    option: str, value: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    field = option.rpartition(".")[2].removeprefix("--")
    with pytest.raises((SystemExit, ValueError)) as caught:
        parse([*MULTITASK, option] if value is None else [*MULTITASK, f"{option}={value}"])
    out, printed = capsys.readouterr()
    assert not out
    if isinstance(caught.value, SystemExit):  # tyro has printed what is wrong
        assert caught.value.code == 2
        assert "Traceback" not in printed
        assert field in printed or field.replace("-", "_") in printed
    else:
        check_refusal(caught.value, field, field.replace("-", "_"))
        assert not printed


CONFIG = "from lorasp_jax.config import *\nfrom lorasp_jax.peft import LoRASP\n"
GET = CONFIG + "def get_config(scale): return Config(name='a', scale=scale, peft=LoRASP({}), {})"
PROGRAMS = {
    "no syntax": "def get_config(",
    "null byte": "a\0b",
    "no function": "",
    "leaves": "import sys\nsys.exit()",
    "leaves with a reason": "import sys\ndef get_config(scale): sys.exit('no')",
    "no such module": "import nowhere_at_all",
    "no such name": "def get_config(scale): return nothing",
    "division": "def get_config(scale): return 1 / 0",
    "nothing": "def get_config(scale): pass",
    "no argument": "def get_config(): return 3",
    "no callable": "get_config = 3",
    "unknown field": GET.format("", "nme=3"),
    "text for a number": GET.format("", "optim=OptimConfig(learning_rate='x')"),
    "text for a whole number": GET.format("", "optim=OptimConfig(steps='x')"),
    "flag for a number": GET.format("", "fsdp=True"),
    "number for a text": GET.format("", "robot=3"),
    "text for a list": GET.format("", "tasks='press'"),
    "numbers in a list": GET.format("", "tasks=(3, 4)"),
    "no list": GET.format("", "tasks=()"),
    "twice": GET.format("", "tasks=('press', 'press')"),
    "not one of them": GET.format("", "model=ModelConfig(dtype='float64')"),
    "rank": GET.format("rank='8'", ""),
    "alpha": GET.format("alpha='8'", ""),
    "method": CONFIG + "def get_config(scale): return Config(name='a', scale=scale, peft='lora')",
    "part": GET.format("", "optim={'steps': 3}"),
}
FIELDS = {
    "rank": "rank must be int, got '8'",
    "alpha": "alpha must be a finite number or None, got '8'",
}
FIELDS |= {"method": "peft must be Method", "part": "optim must be OptimConfig"}
FIELDS |= {"text for a number": "learning_rate must be a finite number"}


@pytest.mark.parametrize("name", PROGRAMS)
def test_invalid_config_files_are_rejected_in_one_sentence(name: str, tmp_path: Path) -> None:
    path = tmp_path / "experiment.py"
    path.write_text(PROGRAMS[name])
    before = path.read_bytes()
    with pytest.raises(Exception) as caught:  # noqa: PT011 (the type is checked below)
        parse(["--config", str(path), "--scale", "smoke"])
    check_refusal(caught.value, str(path))
    assert FIELDS.get(name, "") in str(caught.value)
    assert path.read_bytes() == before
