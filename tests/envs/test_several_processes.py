"""Processes other than the first can make environments, too."""

from tests.several import start

ONE_OF_THEM = """
import jax
from rich.console import Console

import envs
from lorasp_jax.training.distributed import processes

processes.initialize(Console())
assert jax.process_count() == 2
if jax.process_index() == 1:
    env = envs.make("press", num_envs=2, image_size=16)
    assert env.physics._model.opt.timestep.devices() == {jax.local_devices()[0]}
"""


def test_the_second_process_makes_environments():
    children = start(2, "-c", ONE_OF_THEM)
    assert [child.wait() for child in children] == [0, 0]
