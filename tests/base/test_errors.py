"""How commands end."""

import importlib.metadata
import io

import pytest
from rich.console import Console

from lorasp_jax.base.errors import INTERRUPTED, REFUSED, describe_any, run_command


def end(command, **options):
    errors = Console(file=io.StringIO())
    return run_command(command, errors, **options), errors.file.getvalue()


def fail(error):
    def command():
        raise error

    return command


def test_success_is_silent():
    assert end(lambda: None) == (0, "")
    assert end(lambda: 3) == (3, "")


def test_bad_input_is_reported_on_one_line():
    assert end(fail(ValueError("no such\ntask"))) == (REFUSED, "error: no such task\n")
    assert end(fail(MemoryError()), remedy=": buy more") == (
        REFUSED,
        "error: out of memory: buy more\n",
    )


def test_a_bug_is_raised():
    with pytest.raises(KeyError):
        end(fail(KeyError("task")))


def test_any_error_has_a_line_and_a_bug_its_type():
    assert describe_any(ValueError("no such\ntask")) == "no such task"
    assert describe_any(KeyError("task")) == "KeyError: 'task'"
    assert describe_any(KeyboardInterrupt("8 of\n10")) == "KeyboardInterrupt: 8 of 10"
    assert describe_any(KeyboardInterrupt()) == "KeyboardInterrupt"
    assert describe_any(ValueError()) == "ValueError"


def test_an_interruption_says_what_is_left():
    assert end(fail(KeyboardInterrupt())) == (INTERRUPTED, "interrupted\n")
    assert end(fail(KeyboardInterrupt()), interrupted="stopped [1/2]")[1] == "stopped [1/2]\n"
    saved = fail(KeyboardInterrupt("8 of 10 are saved"))
    assert end(saved, interrupted="stopped")[1] == "interrupted; 8 of 10 are saved\n"


@pytest.mark.parametrize(
    ("module", "group"),
    [
        ("mujoco.mjx", "train"),
        ("array_record", "train"),
        ("PIL.Image", "train"),
        ("warp", "warp"),
        ("msgpack", "serving"),
        ("piper_sdk", "piper"),
        ("brax.envs", "brax"),
        ("gcsfs", "buckets"),
    ],
)
def test_a_missing_group_is_named(module, group):
    missing = ModuleNotFoundError("missing", name=module)
    code, text = end(fail(missing))
    assert code == REFUSED
    assert f'pip install "lorasp_jax[{group}]"' in text


def test_without_metadata_the_missing_module_is_raised(monkeypatch):
    def requires(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "requires", requires)
    with pytest.raises(ModuleNotFoundError, match="no brax"):
        end(fail(ModuleNotFoundError("no brax", name="brax")))


def test_a_missing_module_of_ours_is_a_bug():
    with pytest.raises(ModuleNotFoundError):
        end(fail(ModuleNotFoundError("missing", name="lorasp_jax.nothing")))
