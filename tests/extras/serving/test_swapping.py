"""Test that no adapter ever answers for another while adapters are swapped at random.

Rounding depends on what else is in a batch. An answer is therefore taken for that of the adapter
whose answer alone is nearest, which must be far nearer than adapters are to each other.

`python -m tests.extras.serving.test_swapping 100000` runs the same for longer.
"""

import gc
import json
import random
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import jax
import numpy as np
import psutil
import pytest

from lorasp_jax.extras.serving import requests
from lorasp_jax.extras.serving.client import PolicyClient, PolicyError
from lorasp_jax.extras.serving.served import ServedPolicies
from tests.cases import mostly_slow
from tests.extras.conftest import finish_run, write_base
from tests.extras.serving.adapter_runs import get, post, serve_runs, write_run
from tests.extras.serving.stand_in import observation, serving

NAMES, VERSIONS, PICTURES, CLIENTS = ("a", "b", "c", "d"), 2, 2, 8
TOLERANCE = 1e-3  # rad and m; adapters differ by 4


class Swapped:
    """Which versions of each adapter may answer at a time."""

    def __init__(self):
        self.lock = threading.Lock()
        # name -> [version or None if it is unloaded, since, until]
        self.spans = {name: [[0, 0.0, float("inf")]] for name in NAMES}

    def begin(self, name, version):
        with self.lock:
            self.spans[name].append([version, time.monotonic(), float("inf")])

    def end(self, name):
        """The change is done: what was there before no longer answers."""
        with self.lock:
            self.spans[name][-2][2] = time.monotonic()
            del self.spans[name][:-3]

    def allowed(self, name, start):
        """Versions that may answer a request sent at `start`, whose answer has just arrived."""
        with self.lock:
            return {version for version, _, until in self.spans[name] if until >= start}


def fixed_noise(monkeypatch):
    """Let equal requests have equal answers."""
    prepare = ServedPolicies.prepare
    monkeypatch.setattr(
        ServedPolicies,
        "prepare",
        lambda self, adapter, request, index: prepare(self, adapter, request, (0, 0)),
    )


def answers_alone(served):
    """Answers of each adapter alone [adapters, pictures, C, J+1]."""
    pictures = [observation(served.spec, value * 100) for value in range(PICTURES)]
    asked = [requests.parse(picture, served.spec) for picture in pictures]
    return np.stack(
        [
            [served.run(each, [served.prepare(each, one, (0, 0))])[0][0] for one in asked]
            for each in served.adapters
        ]
    )


def distances(actions, others):
    """The largest difference of actions [C, J+1] to each of others [n, C, J+1]."""
    return np.abs(actions - others).max(axis=(1, 2))


class Swaps:
    """Clients that ask, and one thread that swaps, until `total` requests are answered."""

    def __init__(self, server, paths, expected, total, pause, seed=0):
        self.server, self.paths, self.expected, self.total = server, paths, expected, total
        self.who, self.farthest, self.pause = [*paths], 0.0, pause
        self.swapped, self.counts, self.faults, self.seed = Swapped(), Counter(), [], seed
        self.memory = []

    def run(self):
        threads = [threading.Thread(target=self.ask, args=(i,)) for i in range(CLIENTS)]
        for thread in threads:
            thread.start()
        self.swap(any_alive=lambda: any(thread.is_alive() for thread in threads))
        for thread in threads:
            thread.join()

    def ask(self, number):
        rng = random.Random(self.seed * 100 + number)
        try:
            while self.counts["answers"] < self.total and not self.faults:
                self.ask_until_refused(rng)
        except Exception as error:  # a thread must not fail in silence
            self.faults.append(repr(error))

    def ask_until_refused(self, rng):
        with PolicyClient(self.server.address, token="secret", timeout=120) as client:
            while self.counts["answers"] < self.total and not self.faults:
                name, picture = rng.choice(NAMES), rng.randrange(PICTURES)
                sent = observation(self.server.policy.spec, picture * 100, adapter=name)
                start = time.monotonic()
                try:
                    answer = client.infer(sent)["actions"]
                except PolicyError as error:
                    if None not in self.swapped.allowed(name, start):
                        self.faults.append(f"{name} was refused: {error}")
                    self.count("refusals")
                    return
                allowed = self.swapped.allowed(name, start) - {None}
                found = distances(answer, self.expected[:, picture])
                who, distance = self.who[found.argmin()], float(found.min())
                if distance > TOLERANCE or who[0] != name or who[1] not in allowed:
                    self.faults.append(
                        f"{name} of {allowed} was answered by {who}, {distance:.1g} away"
                    )
                self.farthest = max(self.farthest, distance)
                self.count("answers")

    def count(self, what):
        with self.swapped.lock:
            self.counts[what] += 1

    def swap(self, any_alive):
        rng = random.Random(self.seed)
        while any_alive():
            name = rng.choice(NAMES[1:])
            version = rng.choice([*range(VERSIONS), *range(VERSIONS), None])
            values = {"name": name, "path": self.paths.get((name, version))}
            present = self.swapped.spans[name][-1][0] is not None
            if version is None:
                if not present:
                    continue
                values = {"name": name, "remove": True}
            self.swapped.begin(name, version)
            status, text = post(self.server, values)
            while status == 202:  # on a busy machine
                time.sleep(0.1)
                listed = json.loads(get(self.server, "/adapters")[1])
                text, status = listed["last"], 202 if listed["loading"] else 200
            if status != 200 or not text.startswith((f"{name} answers", f"{name} is unloaded")):
                self.faults.append(text)
            self.swapped.end(name)
            self.counts["swaps"] += 1
            if self.counts["swaps"] % 20 == 0:
                used = sum(array.nbytes for array in jax.live_arrays())
                resident = psutil.Process().memory_info().rss
                self.memory.append((self.counts["answers"], used, resident))
            time.sleep(self.pause)


def swaps(source, folder, total, patch, pause=0.05):
    """Run `Swaps` on new adapters, with this time between swaps [s]; return it."""
    paths = {
        (name, v): write_run(source, folder / f"{name}{v}", 10 * i + v)
        for i, name in enumerate(NAMES)
        for v in range(VERSIONS)
    }
    fixed_noise(patch)
    alone = serve_runs({f"{n}{v}": path for (n, v), path in paths.items()}, max_batch=4)
    expected = answers_alone(alone)
    every = expected.reshape(-1, *expected.shape[2:])
    apart = [distances(each, np.delete(every, i, 0)).min() for i, each in enumerate(every)]
    assert min(apart) > 100 * TOLERANCE, "no two adapters have nearly equal answers"
    del alone
    gc.collect()
    served = serve_runs({name: paths[name, 0] for name in NAMES}, max_batch=4, capacity=2)
    served.warm_up()
    with serving(served, token="secret") as server:
        result = Swaps(server, paths, expected, total, pause)
        start = time.monotonic()
        result.run()
        result.seconds = time.monotonic() - start
        result.counts.update(server.counts)
        result.apart = float(min(apart))
    return result


@pytest.mark.parametrize("total", mostly_slow([300, 3_000], [300]))
def test_no_adapter_answers_for_another(total, finished, tmp_path, monkeypatch):
    result = swaps(finished.folder, tmp_path, total, monkeypatch)
    assert result.faults == []
    assert result.counts["answers"] >= total
    assert result.counts["swaps"] >= 3
    if total > 1000:  # memory is flat
        third = result.memory[len(result.memory) // 3]
        _, arrays, resident = result.memory[-1]
        assert arrays < 1.2 * third[1]
        assert resident < 1.1 * third[2]


def main(total):
    """Run from the command line; prints what happened."""
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        source = finish_run(Path(folder) / "run", write_base(Path(folder))).folder
        result = swaps(source, Path(folder), total, patch, pause=0.5)
    pace = result.counts["answers"] / result.seconds
    print(dict(result.counts), f"{pace:.0f} answers/s", "faults:", result.faults or "none")
    print(f"farthest from its adapter {result.farthest:.1g}, adapters {result.apart:.1g} apart")
    for answers, used, resident in result.memory[:: max(1, len(result.memory) // 12)]:
        print(f"{answers:7d} answers: arrays {used / 1e6:.2f} MB, resident {resident / 1e6:.0f} MB")


if __name__ == "__main__":
    main(int(sys.argv[1]))
