import importlib
from pathlib import Path

import pytest

from lorasp_jax.base import compilation_cache, user_cache
from tests import ROOT


@pytest.fixture
def nobody(monkeypatch):
    """A user without a home directory, as systemd's DynamicUser and `docker run --user 4242`."""

    def home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", home)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)


def test_a_user_without_a_home_hears_what_to_set(nobody):
    with pytest.raises(ValueError, match="no home directory: set HOME to a folder"):
        user_cache.user_cache()


def test_a_named_cache_needs_no_home(nobody, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert user_cache.user_cache() == tmp_path / "lorasp_jax"


@pytest.mark.parametrize("environment", [{}, {"XDG_CACHE_HOME": ""}])
def test_the_default(monkeypatch, tmp_path, environment):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    for name, value in {"HOME": str(tmp_path), **environment}.items():
        monkeypatch.setenv(name, value)
    assert user_cache.user_cache() == tmp_path / ".cache" / "lorasp_jax"


@pytest.mark.parametrize(
    ("module", "words"),
    [
        ("lorasp_jax.cli.train", f"--config {ROOT}/configs/multitask.py --dry-run"),
        ("lorasp_jax.extras.serving.__main__", "assets/pi0_nano --joints 7"),
        ("lorasp_jax.extras.piper.fake.__main__", "--expert"),
        ("envs.__main__", "collect --task press --robot piper --out nowhere"),
    ],
)
def test_commands_say_it_in_a_sentence(monkeypatch, capsys, module, words):
    def enable():
        raise ValueError("no home")

    monkeypatch.setattr(compilation_cache, "enable", enable)
    assert importlib.import_module(module).main(words.split(), "x") == 2
    assert "error: no home" in capsys.readouterr().err
