"""Code of the child processes of test_commands.py: collections that are killed."""

import itertools
import os
import signal

import jax
import numpy as np

from envs import __main__ as command_line
from envs.datasets import rlds, rlds_schema
from envs.experts import collection

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


def collect_and_die(moment, out):
    """In a child process: collect until killed."""
    collection.record_expert = fake_record
    die_at(*MOMENTS[moment])
    command_line.main([*COLLECT.split(), "--out", out])
