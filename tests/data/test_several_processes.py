"""`convert` in concurrent and killed processes: a cache is complete or absent."""

import os
import random
import subprocess
import sys
import time

import pytest

from lorasp_jax.base.locks import locked
from lorasp_jax.data import cache
from lorasp_jax.data.__main__ import main
from lorasp_jax.data.lerobot import Keys, LeRobot
from tests.cases import mostly_slow
from tests.data.lerobots import golden

KILLS = 12


def convert(out):
    """Start a conversion in a new process."""
    command = [sys.executable, "-m", "lorasp_jax.data", "convert", golden("v3"), "--out", out]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Files that an undisturbed conversion writes."""
    path = tmp_path_factory.mktemp("whole") / "cache"
    cache.write([LeRobot(golden("v3"), Keys(image_size=224))], path, lambda *_: None)
    return files(path)


@pytest.mark.parametrize("seed", mostly_slow(range(KILLS), [6]))
def test_killed_at_any_moment(whole, tmp_path, seed):
    """Between the first file and a little after the last one."""
    out, part = tmp_path / "cache", (seed + random.random()) / KILLS
    child = convert(out)
    while not list(tmp_path.iterdir()):
        time.sleep(0.001)
    time.sleep(0.2 * part)  # s; about half of the conversions finish
    child.kill()
    child.communicate()
    if not out.exists():
        assert main(["convert", str(golden("v3")), "--out", str(out)]) == 0
        assert os.listdir(tmp_path) == ["cache"]
    assert files(out) == whole


def test_a_second_writer_is_refused(tmp_path):
    out = tmp_path / "cache"
    with locked(out), pytest.raises(ValueError, match="cache"):
        cache.write([LeRobot(golden("v3"))], out, lambda *_: None)
    assert not list(tmp_path.iterdir())
