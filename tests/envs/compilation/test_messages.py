"""A line where something compiles for long, none where it does not."""

import time

import jax
import pytest

import envs
from envs.compilation import messages


@pytest.fixture
def impatient(monkeypatch):
    """Where nothing is kept for the next start."""
    monkeypatch.setattr(messages, "PATIENCE", 0.05)
    before = jax.config.jax_enable_compilation_cache
    jax.config.update("jax_enable_compilation_cache", False)
    yield
    jax.config.update("jax_enable_compilation_cache", before)


def test_long_work_is_said_while_it_goes_on(impatient, capsys):
    with messages.said("the world"):
        time.sleep(0.3)
        assert capsys.readouterr() == ("", "compiling the world ...\n")
    assert capsys.readouterr().err.startswith("compiled the world in 0 s")


def test_where_programs_are_kept_it_is_long_the_first_time_only(impatient, capsys):
    jax.config.update("jax_enable_compilation_cache", True)
    with messages.said("the world"):
        time.sleep(0.3)
    told = "compiling the world (long the first time only) ...\ncompiled the world in 0 s\n"
    assert capsys.readouterr().err == told


def test_short_work_is_not_said(capsys):
    with messages.said("the world"):
        pass
    assert capsys.readouterr() == ("", "")


def test_an_error_is_not_called_done(impatient, capsys):
    def fail():
        with messages.said("the world"):
            time.sleep(0.3)
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert capsys.readouterr().err == "compiling the world ...\n"


def test_the_first_process_alone_says_it(impatient, capsys, monkeypatch):
    monkeypatch.setattr(jax, "process_index", lambda: 1)
    with messages.said("the world"):
        time.sleep(0.2)
    assert capsys.readouterr() == ("", "")


def test_an_environment_says_it_once(impatient, capsys):
    env = envs.make("press", num_envs=2, image_size=8)
    jax.eval_shape(env.reset, jax.random.key(0))  # nothing is compiled
    assert capsys.readouterr().err == ""
    env.reset(jax.random.key(0))
    said = capsys.readouterr().err
    assert said.startswith("compiling reset of press, 2 worlds ...\ncompiled reset of press")
    env.reset(jax.random.key(1))
    assert capsys.readouterr().err == ""
