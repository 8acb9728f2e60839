"""Validation and help of command-line options."""

import pytest

from envs import __main__ as command_line
from tests.envs.children import COLLECT


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("--seed 99999999999999999999", "argument --seed: must be 0 to 4294967295, got 99"),
        ("--seed -1", "argument --seed: must be 0 to"),
        ("--seed one", "argument --seed: invalid seed value: 'one'"),
        ("--control-dt inf", "argument --control-dt: must be a finite number, got inf"),
        ("--action-noise nan", "argument --action-noise: must be a finite number, got nan"),
    ],
)
def test_invalid_numbers(tmp_path, capsys, text, message):
    with pytest.raises(SystemExit, match="2"):
        command_line.main([*COLLECT.split(), "--out", str(tmp_path / "new"), *text.split()])
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_help_describes_options(capsys):
    for command, texts in (
        ("play", ("with --out: height", "or the path of an MJCF file")),
        ("collect", ("or the path of an MJCF file",)),
    ):
        with pytest.raises(SystemExit, match="0"):
            command_line.main([command, "--help"])
        help_text = " ".join(capsys.readouterr().out.split())
        assert all(text in help_text for text in texts)
