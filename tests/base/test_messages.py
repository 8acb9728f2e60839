"""Long compilations print a line, short ones do not."""

import re
import threading

import jax
import pytest

import envs
from lorasp_jax.base import messages


@pytest.fixture
def impatient(monkeypatch):
    """Announce after 50 ms, and disable the compilation cache."""
    monkeypatch.setattr(messages, "PATIENCE", 0.05)
    before = jax.config.jax_enable_compilation_cache
    jax.config.update("jax_enable_compilation_cache", False)
    yield
    jax.config.update("jax_enable_compilation_cache", before)


@pytest.fixture
def printed(monkeypatch):
    """An event: a line has been printed, if this process prints."""
    event, show = threading.Event(), messages._print

    def noticed(line):
        show(line)
        event.set()

    monkeypatch.setattr(messages, "_print", noticed)
    return event


def test_long_compilation_is_announced(impatient, printed, capsys):
    with messages.announce("the world"):
        assert printed.wait(60)
        assert capsys.readouterr() == ("", "compiling the world ...\n")
    assert re.match(r"compiled the world in \d+ s", capsys.readouterr().err)


def test_with_a_cache_only_the_first_time_is_slow(impatient, printed, capsys):
    jax.config.update("jax_enable_compilation_cache", True)
    with messages.announce("the world"):
        assert printed.wait(60)
    lines = r"compiling the world \(slow only the first time\) ...\ncompiled the world in \d+ s\n"
    assert re.fullmatch(lines, capsys.readouterr().err)


def test_short_compilation_is_silent(capsys):
    with messages.announce("the world"):
        pass
    assert capsys.readouterr() == ("", "")


def test_an_error_is_not_reported_as_done(impatient, printed, capsys):
    def fail():
        with messages.announce("the world"):
            assert printed.wait(60)
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert capsys.readouterr().err == "compiling the world ...\n"


def test_only_the_first_process_prints(impatient, printed, capsys, monkeypatch):
    monkeypatch.setattr(jax, "process_index", lambda: 1)
    with messages.announce("the world"):
        assert printed.wait(60)
    assert capsys.readouterr() == ("", "")


def test_an_environment_announces_once(impatient, capsys):
    env = envs.make("press", num_envs=2, image_size=8)
    jax.eval_shape(env.reset, jax.random.key(0))  # nothing is compiled
    assert capsys.readouterr().err == ""
    env.reset(jax.random.key(0))
    output = capsys.readouterr().err
    assert output.startswith("compiling reset of press, 2 worlds ...\ncompiled reset of press")
    env.reset(jax.random.key(1))
    assert capsys.readouterr().err == ""
