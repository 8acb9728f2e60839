"""Code of the child processes of test_commands.py: collections that end abruptly."""

import itertools
import os
import signal
import subprocess
import sys
import threading

import jax
import numpy as np

from envs import __main__ as command_line
from envs.datasets import rlds, rlds_schema
from envs.experts import collection
from tests import ROOT

COLLECT = "collect --task press --robot piper --num-episodes 20 --num-envs 6 --image-size 16"
# Where a process is killed: a function, and the number of the fatal call.
MOMENTS = {
    "in the middle of a shard": (rlds_schema, "record", 9),
    "before the second shard is listed": (os, "replace", 3),
    "before the next shard": (collection, "record_expert", 4),
    "when all shards are complete": (rlds.ShardWriter, "complete", 1),
    "before the dataset is in place": (os, "rename", 1),
}


def fake_record(env, key, action_noise, ranges):
    """Replace the simulation: images are noise, and some attempts fail."""
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    size, width = (env.num_envs, 5), env.num_joints + 1
    episodes = {
        "image": {
            name: rng.integers(0, 256, (*size, 4, 4, 3), dtype=np.uint8) for name in env.cameras
        },
        "state": rng.normal(size=(*size, width)).astype(np.float32),
        "action": rng.normal(size=(*size, width)).astype(np.float32),
        "length": rng.integers(1, 6, env.num_envs, dtype=np.int32),
        "instruction": rng.integers(0, len(env.instructions), env.num_envs, dtype=np.int32),
    }
    return episodes, rng.random(env.num_envs) < 0.8


def die_at(owner, name, call):
    """Kill the process, as by kill -9, in place of a function's call with this number."""
    survived, count = getattr(owner, name), itertools.count(1)

    def deadly(*arguments, **options):
        if next(count) == call:
            os.kill(os.getpid(), signal.SIGKILL)
        return survived(*arguments, **options)

    setattr(owner, name, deadly)


def run_child(call):
    """Run one of the functions below in a child process, and wait for it."""
    code = f"from tests.envs import children; children.{call}"
    root = ROOT
    return subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, check=False)


def collect_and_die(moment, out):
    """In a child process: collect until killed."""
    collection.record_expert = fake_record
    die_at(*MOMENTS[moment])
    command_line.main([*COLLECT.split(), "--out", out])


def collect_and_interrupt(out):
    """In a child process: collect, with Ctrl-C during the second shard."""
    calls, noticed = itertools.count(), threading.Event()

    def notice(*_):
        noticed.set()
        raise KeyboardInterrupt

    def record(*arguments):
        if next(calls) == 1:
            os.kill(os.getpid(), signal.SIGINT)
            assert noticed.wait(60)  # the main thread may be slow on a busy machine
        return fake_record(*arguments)

    signal.signal(signal.SIGINT, notice)
    collection.record_expert = record
    sys.exit(command_line.main([*COLLECT.split(), "--out", out]))
