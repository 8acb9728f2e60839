"""Test that a batch of several adapters answers as batches of one."""

import dataclasses
import json

import numpy as np
import pytest
from flax import nnx

from lorasp_jax import adapt, models
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import native
from lorasp_jax.extras.serving import policies
from lorasp_jax.models import presets
from lorasp_jax.peft import AdaLoRA, DoRA, FullFineTuning, LoRA, LoRAMoE, LoRASP
from lorasp_jax.policies.statistics import Statistics
from lorasp_jax.training import export
from tests.cases import mostly_slow
from tests.extras.serving.adapter_runs import TEXTS, get, serve_runs, write_run
from tests.extras.serving.stand_in import serving
from tests.extras.serving.test_policies import request
from tests.models.random_models import with_noise


def write_adapter(source, folder, method, seed, targets="openpi"):
    """Write a run like that in `source`, with adapters of another method."""
    base = models.load(export.RecordedPolicy.read(source).source)
    adapted = adapt(base, presets.rules(targets, method), rngs=nnx.Rngs(0))
    graphdef, adapters, frozen = adaptation.split(adapted)
    model = nnx.merge(graphdef, with_noise(adapters, 0.3, seed), frozen)
    metadata = export.describe(source)
    statistics = Statistics.from_json(json.dumps(metadata["policy"]["statistics"]))
    action = statistics.action | {"mean": statistics.action["mean"] + 0.1 * seed}
    statistics = dataclasses.replace(statistics, action=action)
    metadata["policy"]["statistics"] = json.loads(statistics.to_json())
    native.save_adapters(folder, model, metadata=metadata)
    return str(folder)


def rows_of(served, names):
    """A request to each adapter, and its row."""
    adapters = [served._find(name) for name in names]
    asked = [request(served.spec, i, TEXTS["press"][0]) for i in range(len(names))]
    rows = [served.prepare(a, r, (0, i)) for i, (a, r) in enumerate(zip(adapters, asked))]  # noqa: B905
    return adapters, rows


# rad and m. Rounding alone makes two copies in a batch differ from one by 1e-4, and guidance, which
# takes derivatives, makes more of it; adapters differ by more than 1.
TOLERANCES = {"naive": 2e-4, "guided": 5e-3}
METHODS = LoRA(rank=4), LoRASP(rank=8), DoRA(rank=4), AdaLoRA(), LoRAMoE()
CASES = [(method, "naive") for method in METHODS] + [(m, "guided") for m in METHODS[:2]]


@pytest.mark.parametrize("case", mostly_slow(CASES, CASES[:2]), ids=lambda c: f"{c[0].name} {c[1]}")
def test_answers_are_those_of_batches_of_one_adapter(case, finished, tmp_path):
    method, execution = case
    paths = {
        n: write_adapter(finished.folder, tmp_path / n, method, i) for i, n in enumerate("abc")
    }
    settings = {"execution": execution, "max_batch": 4, "together": 4}
    served = serve_runs(paths, **settings, guidance=5.0 if execution == "guided" else None)
    names = ["a", "b", "c", "a"]
    assert served.companions(served._find("a")) == ["b", "c"]
    adapters, rows = rows_of(served, names)
    if execution == "guided":
        for row in rows:
            row["overlap"] = np.array(3, np.int32)
            row["previous"][:3] = 0.5
    found, ranks = served.run_mixed(adapters, rows)
    assert (ranks is None) == (method.name != "lora_sp")
    for i, (adapter, row, actions) in enumerate(zip(adapters, rows, found, strict=True)):
        alone, rank = served.run_mixed([adapter], [row])
        np.testing.assert_allclose(actions, alone[0], atol=TOLERANCES[execution])
        if ranks is not None:
            assert 1 < ranks[i] < 8
            np.testing.assert_allclose(ranks[i], rank[0], atol=0.02)  # rounding moves few tokens
    others, _ = served.run_mixed(adapters[1:3] + adapters[:2], rows)
    assert np.abs(found - others).max(axis=(1, 2)).min() > 0.5, "adapters differ far more"


def test_adapters_that_make_other_programs_have_batches_of_their_own(finished, tmp_path):
    """Each of these changes what one program could not hold: see `policies.run_mixed`."""
    make = lambda name, *more: write_adapter(finished.folder, tmp_path / name, *more)  # noqa: E731
    paths = {
        "a": make("a", LoRA(rank=4), 0),
        "b": make("b", LoRA(rank=4), 1),
        "padded": make("padded", LoRA(rank=2, alpha=1, dropout=0.1), 2),
        "rank": make("rank", LoRA(rank=20), 2),
        "layers": make("layers", LoRA(rank=4), 3, "language"),
        "method": make("method", LoRASP(rank=4), 4),
        "kernels": make("kernels", FullFineTuning(), 6, "language"),
        "kernels too": make("kernels too", FullFineTuning(), 7, "language"),
    }
    delta = {"inputs": dataclasses.asdict(finished.policy.model.config.inputs) | {"delta": [True]}}
    paths["delta"] = write_run(finished.folder, tmp_path / "delta", 5, config=delta)
    served = serve_runs(paths, max_batch=2, together=2)
    found = {each.name: served.companions(each) for each in served.adapters}
    same = {"a": ["b", "padded"], "b": ["a", "padded"], "padded": ["a", "b"]}
    assert found == {name: [] for name in paths} | same
    with serving(served, token="secret") as server:
        listed = json.loads(get(server, "/adapters")[1])["adapters"]
    assert {each["name"]: each["batches_with"] for each in listed} == found
    served.together = 1
    assert not any(map(served.companions, served.adapters)), "by default, one adapter a batch"
    own = serve_runs({n: paths[n] for n in ("a", "b")}, share=False, max_batch=1, together=2)
    assert not any(map(own.companions, own.adapters)), "weights of their own"


def test_mixed_batches_are_warm_before_a_request_comes(finished, tmp_path):
    """Neither the first such batch nor an adapter that was loaded later compiles anything."""
    path = lambda i: write_run(finished.folder, tmp_path / str(i), i)  # noqa: E731
    served, said = serve_runs({"a": path(0), "b": path(1)}, max_batch=4, together=4), []
    served.warm_up(said.append)
    assert said[-1] == "compiling a with b, batch 4 (8 of 8)"
    compiled = policies._mixed_program()._cache_size()
    served.put("c", path(2))
    for names in ("ab", "ca", "abcb", "cccb"):
        served.run_mixed(*rows_of(served, names))
    assert policies._mixed_program()._cache_size() == compiled
