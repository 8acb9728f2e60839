"""Test the arithmetic of the benchmarks, not the measured values."""

import argparse
import functools
import json
import socket
import socketserver
import threading
import time
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from benchmarks import (
    compile_time,
    data,
    deployment,
    long_run,
    pictures,
    scaling,
    serving,
    small_cards,
)
from benchmarks.deployment import Case
from envs.state import State
from lorasp_jax import peft
from lorasp_jax.data.cache import Cache
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.training.distributed import mesh as meshes


def report(broken=0, **memory):
    return long_run.Report(1, 1.0, broken, memory, 1.0)


@pytest.mark.parametrize(
    ("reports", "passes"),
    [
        ([report(host=100.0), report(host=101.9)], True),
        ([report(host=100.0), report(host=102.1)], False),
        ([report(host=100.0, JAX=5.0), report(host=90.0, JAX=6.0)], False),
        ([report(host=100.0), report(1, host=100.0)], False),
    ],
)
def test_long_run_passes_if_no_memory_grows_and_no_world_breaks(reports, passes):
    assert long_run.passed(reports) == passes


@pytest.mark.parametrize("episodes", [1, 3, 5, 7, 200])
def test_long_run_reports_at_its_end(episodes, monkeypatch):
    class Worlds:
        num_envs = 2

        def reset(self, key, ranges):
            return None

    info = {"success": 1, "broken": 0}
    monkeypatch.setattr(long_run.jax, "jit", lambda _: lambda state, key: (state, info))
    monkeypatch.setattr(long_run, "memory", lambda env: {"host": 1.0})
    reports = list(long_run.run(Worlds(), episodes))
    assert len(reports) == min(episodes, 5)
    assert reports[-1].episodes == episodes
    assert reports[-1].success == 0.5


def test_a_long_run_plans_with_other_keys_than_it_restarts(monkeypatch):
    """A plan splits its key as a restart does: from one key, its noise would be the layout's."""
    keys, zero = [], np.zeros(1)

    def note(_, state, key, *__):
        keys.append(key)
        return state

    state = State(None, zero, zero, {}, {"success": zero, "broken": zero})
    worlds = SimpleNamespace(num_envs=1, expert_steps=0, reset=lambda *_: state)
    worlds.reset_done, worlds.step = functools.partial(note, worlds), lambda state, _: state
    worlds.observe = lambda _: {"image": {}}
    monkeypatch.setattr(long_run.expert, "plan", note)
    monkeypatch.setattr(long_run.expert, "act", lambda *_: None)
    monkeypatch.setattr(long_run, "memory", lambda env: {})
    list(long_run.run(worlds, 1))
    restart, plan = keys
    assert restart is not plan


@pytest.mark.slow
def test_long_run(capsys):
    arguments = ["--tasks", "press", "--backend", "jax", "--episodes", "5", "--num-envs", "2"]
    assert long_run.main(arguments) == 0
    assert "5 episodes" in capsys.readouterr().out


def test_data_reading(tmp_path):
    row = data.read_cache(tmp_path, 500, (4, 6), batch=8, batches=3)
    assert (row["images"], row["batch"]) == ("6x4", 8)
    assert row["windows/s"] > 0
    cache = Cache(tmp_path / "4x6")
    assert (len(cache), cache.num_steps, cache.cameras["wrist"]) == (2, 500, [4, 6])


@pytest.mark.slow
def test_small_cards(tmp_path):
    """A row that `--fit` chooses, which a second call leaves out, and one with given settings."""
    rows = small_cards.table(["nano", "nano_pi05"])
    assert len({json.dumps(row) for row in rows}) == len(rows) == 19
    results = tmp_path / "rows.jsonl"
    for row in (rows[0], rows[3]):
        assert small_cards.waiting([row], results) == [row]
        small_cards.work(row, results)
        assert small_cards.waiting([row], results) == []
    given, fitted = small_cards.read(results)
    assert (given["base"], given["remat"], given["parts"]) == ("nf4", "products", 1)
    assert fitted["remat"] == "none"
    for row in (given, fitted):
        assert row["planned"] > 0 < row["samples/s"]


@pytest.mark.slow
def test_scaling(monkeypatch):
    """One device, then two, with the base replicated and sharded."""
    tiny = Pi0Config.dummy()
    monkeypatch.setattr(scaling.backbones, "sized", lambda *_: tiny)
    monkeypatch.setattr(meshes, "shardings", functools.partial(meshes.shardings, minimum=1024))
    options = argparse.Namespace(
        backbone="pi0", size="nano", devices=[1, 2], batch=2, rank=4, remat="none", calls=1
    )
    options.threads = 1
    rows = list(scaling.rows(options))
    assert [(row["layout"], row["devices"]) for row in rows] == [
        ("data", 1),
        ("data", 2),
        ("fsdp", 2),
    ]
    assert rows[0]["efficiency"] == 1
    assert all(row["samples/s"] > 0 for row in rows)
    assert rows[2]["GiB"] < rows[1]["GiB"]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # qwix uses deprecated Flax APIs
def test_compile_time(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(peft, "names", lambda: ("lora", "lora_sp"))
    monkeypatch.setattr(jax, "clear_caches", lambda: None)  # other tests go on in this process
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    sizes = ["--depth", "1", "--width", "16", "--tokens", "8", "--rank", "4", "--repeats", "1"]
    compile_time.main([*sizes, "--json", str(tmp_path / "results.json")])
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert {"bare", *peft.names()} <= {row["model"] for row in rows}
    assert rows[0]["ratio"] == 1
    assert "lora_sp" in capsys.readouterr().out


@pytest.mark.slow
def test_serving():
    # A batch takes so long that this holds on a machine busy with other tests, too.
    command = serving.waiting_command(image_size=16, cameras=1, seconds=0.1)
    (one, times), (eight, times_of_eight) = serving.measure(command, calls=10)
    assert (times.shape, times_of_eight.shape) == ((10, 3), (80, 3))
    assert (times[:, 0] > times[:, 1]).all()
    assert (times[:, 1] >= 100).all()
    assert eight > 2 * one


DUMMY = argparse.Namespace(
    backbones=["pi0"],
    size="dummy",
    rank=16,
    dtype="float32",
    cameras=0,
    repeats=1,
    only_adapters=False,
)


@pytest.mark.slow
def test_merged_adapters_run_the_program_of_the_base():
    config = deployment.of_size("pi0", DUMMY)
    text = {
        adapters: deployment.lowered(Case("pi0", adapters, 1), config, 16)[2].as_text()
        for adapters in ("none", "merged", "whole")
    }
    assert text["none"] == text["merged"] != text["whole"]


def test_half_of_the_bank_is_smaller():
    config = deployment.of_size("pi0", DUMMY)
    sizes = [
        sum(leaf.size for leaf in jax.tree.leaves(deployment.abstract_sampler(case, config, 16)))
        for case in (Case("pi0", name) for name in ("none", "half", "whole"))
    ]
    assert sizes[0] < sizes[1] < sizes[2]


def test_failing_programs_become_rows(monkeypatch):
    lowered, table = deployment.lowered, [Case("pi0", "none", 1), Case("pi0", "whole", 1)]

    def fail(case, *arguments):
        if case.adapters == "whole":
            raise RuntimeError("cuDNN is not installed")
        return lowered(case, *arguments)

    monkeypatch.setattr(deployment, "lowered", fail)
    first, second = deployment.measured(table, DUMMY, {})
    assert first["ms"] > 0
    assert second["error"] == "RuntimeError: cuDNN is not installed"
    monkeypatch.setattr(deployment, "rows", lambda _: [first, second])
    assert deployment.main([]) == 1


@pytest.mark.slow
def test_deployment():
    rows = list(deployment.rows(DUMMY))
    assert [row["adapters"] for row in rows[:4]] == ["none", "merged", "whole", "half"]
    assert {row["change"] for row in rows[4:]} == {"", "separate", "graph", "cudnn"}
    assert rows[0]["ratio"] == 1
    assert all(row["ms"] > 0 for row in rows)


def test_the_link_delays_and_throttles():
    """12.5 kB at 1 Mbit/s take 100 ms, and 25 ms there and back each."""

    class Echo(socketserver.BaseRequestHandler):
        def handle(self):
            while data := self.request.recv(4096):
                self.request.sendall(data)

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Echo) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, daemon=True).start()
        seconds = []
        with (
            pictures.Link(server.server_address[1], bits=1e6, round_trip=0.05) as link,
            socket.create_connection(("127.0.0.1", link.port)) as client,
        ):
            for size in (1, 12_500):
                start = time.monotonic()
                client.sendall(bytes(size))
                while size := size - len(client.recv(min(size, 4096))):
                    pass
                seconds.append(time.monotonic() - start)
        server.shutdown()
    assert seconds[0] >= 0.05
    assert 0.15 <= seconds[1] < 2


def test_jpeg_costs_fewer_bytes_and_some_time():
    x = np.linspace(0, 255, 64).astype(np.uint8)
    observation = {"image": {"side": np.broadcast_to(x[:, None, None], (64, 64, 3))}}
    raw, small = (pictures.costs(observation, quality) for quality in (None, 90))
    assert small["kB a call"] < raw["kB a call"] / 5
    assert raw["encode ms"] == 0 < min(small.values())


def test_a_policy_that_waits_answers_over_a_link():
    images = {f"camera{i}": np.zeros((64, 64, 3), np.uint8) for i in range(pictures.CAMERAS)}
    observation = {"image": images, "state": np.zeros(7, np.float32), "prompt": "go"}
    link = {"number": 1, "bits": 1e9, "round_trip": 0.0}
    times = pictures.over_link(observation, [None, 90], **link)
    assert min(times) >= 20  # milliseconds of the policy
