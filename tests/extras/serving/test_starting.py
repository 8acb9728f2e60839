"""Test what makes a server's second start quick: programs that are kept, and few imports."""

import subprocess
import sys

import jax

from tests import ROOT
from tests.extras.serving.test_policies import compiled, make_policy


def test_servers_of_different_seeds_run_the_same_programs():
    """If a seed were a constant of a program, every start would compile it."""
    policies = [compiled({"base": make_policy()}, seed=seed) for seed in (1, 2)]
    index = jax.ShapeDtypeStruct((1, 2), "int32")
    first, second = (each._draw.lower(each._key, index, (4, 7)).as_text() for each in policies)
    assert first == second


def test_a_server_does_not_import_what_only_training_needs():
    code = """if True:
        import sys
        from lorasp_jax.extras.serving import __main__, loading, served, server
        print(*{name.partition(".")[0] for name in sys.modules})
    """
    words = [sys.executable, "-c", code]
    found = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert not {"torch", "tensorboardX", "matplotlib", "mujoco", "grain"} & {*found.split()}
