"""Test that adapters share one base, can change while others answer, and never get mixed up."""

import dataclasses
import gc
import json
from pathlib import Path

import numpy as np
import pytest
from flax import nnx
from rich.console import Console

import lorasp_jax
from lorasp_jax import models
from lorasp_jax.adapters.io import native
from lorasp_jax.extras.serving import __main__ as command
from lorasp_jax.extras.serving import exported, policies
from lorasp_jax.extras.serving.adapters import Bases
from lorasp_jax.extras.serving.client import PolicyClient, PolicyError
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import DoRA, LoRA
from lorasp_jax.training import export
from tests.extras.serving.adapter_runs import (
    TEXTS,
    get,
    live_bytes,
    post,
    serve_runs,
    write_run,
)
from tests.extras.serving.stand_in import observation, serving
from tests.extras.serving.test_policies import actions, request
from tests.models.random_models import random_backbone, with_noise


@pytest.fixture(scope="module")
def runs(finished, tmp_path_factory):
    """Runs of one base by name."""
    root = tmp_path_factory.mktemp("adapters")
    return {n: write_run(finished.folder, root / n, i, t) for i, (n, t) in enumerate(TEXTS.items())}


@pytest.fixture(scope="module")
def foreign(finished, tmp_path_factory):
    """A run of another base."""
    root = tmp_path_factory.mktemp("foreign")
    models.save(root / "base", random_backbone(Pi0Config.dummy(), seed=7))
    folder = root / "run"
    write_run(finished.folder, folder, 9)
    policy = export.load_policy(folder, base=str(root / "base"), any_base=True)
    metadata = export.describe(folder)
    metadata["base"] = str(root / "base")
    native.save_adapters(folder, policy.model, metadata=metadata)
    return str(folder)


ROUNDING = 1e-4
"""Between two programs, of actions up to 10; those of two adapters differ by 0.01 and more."""


@pytest.fixture(scope="module")
def served(runs):
    return serve_runs(runs)


def asked(served, name, seed=0):
    return request(served.spec, seed, TEXTS[name][0], adapter=name)


def test_answers_are_those_of_policies_with_weights_of_their_own(served, runs):
    own = serve_runs(runs, share=False)
    answers = {}
    for name in runs:
        answers[name] = actions(served, asked(served, name))
        np.testing.assert_allclose(answers[name], actions(own, asked(own, name)), atol=ROUNDING)
    assert np.abs(answers["press"] - answers["pour"]).max() > 0.01


def test_ten_adapters_cost_one_base_and_ten_adapters(finished, tmp_path):
    paths = {f"a{i}": write_run(finished.folder, tmp_path / f"a{i}", i) for i in range(10)}
    gc.collect()
    before, program = live_bytes(), policies._program()
    served = serve_runs(paths, max_batch=1)
    served.warm_up()
    gc.collect()
    used, compiled = live_bytes() - before, program._cache_size()
    model = served.adapters[0].policy.policy.model
    base = sum(array.nbytes for array in model.base)
    adapter = sum(array.nbytes for array in model.own)
    small = 100_000  # statistics and tables of ten policies
    assert base + 10 * adapter <= used < base + 10 * adapter + small < 2 * base + 10 * adapter
    shared = {id(array) for each in served.adapters for array in each.policy.policy.model.base}
    assert len(shared) == len(model.base)
    served.put("a10", write_run(finished.folder, tmp_path / "a10", 10))
    assert program._cache_size() == compiled, "adapters of equal shapes share their programs"


def test_at_most_k_adapters_are_on_the_device(runs, served):
    limited = serve_runs(runs, capacity=2, max_batch=1)
    for name in ("press", "pour", "press", "open", "press", "pour"):
        np.testing.assert_array_equal(
            actions(limited, asked(limited, name)), actions(served, asked(served, name))
        )
    held = [each.name for each in limited.adapters if each.policy.policy in limited.place]
    assert (held, limited.place.loads) == (["press", "pour"], 4), "the last used ones are kept"
    places = {name: "on the device" if name in held else "in host memory" for name in runs}
    assert limited.places == places


def test_an_unloaded_adapter_leaves_the_device_after_its_last_request(runs):
    served = serve_runs(runs, max_batch=1)
    sent = asked(served, "pour")
    adapter = served.route(sent)
    row, expected = served.prepare(adapter, sent, (0, 0)), actions(served, sent)
    gc.collect()
    before, own = live_bytes(), sum(array.nbytes for array in adapter.policy.policy.model.own)
    served.remove("pour")
    np.testing.assert_array_equal(served.run(adapter, [row])[0], expected)
    with pytest.raises(ValueError, match="one of press, open, got 'pour'"):
        served.route(sent)
    del adapter
    assert live_bytes() <= before - own


def test_adapters_change_by_post(runs, finished, tmp_path):
    served = serve_runs({name: runs[name] for name in ("press", "pour")}, max_batch=1)
    other = write_run(finished.folder, tmp_path / "other", 5)
    with serving(served, token="secret") as server:
        with PolicyClient(server.address, token="secret") as client:
            sent = observation(served.spec, adapter="pour")
            first = client.infer(sent)["actions"]
            client.reset()
            assert post(server, {"name": "pour", "path": other})[0] == 200
            assert np.abs(client.infer(sent)["actions"] - first).max() > 0.01
            assert post(server, {"name": "open", "path": runs["open"]})[0] == 200
            client.infer(observation(served.spec, adapter="open"))
            assert post(server, {"name": "open", "remove": True}) == (200, "open is unloaded\n")
            with pytest.raises(PolicyError, match="must be one of press, pour, got 'open'"):
                client.infer(observation(served.spec, adapter="open"))
        listed = json.loads(get(server, "/adapters")[1])
        assert [each["name"] for each in listed["adapters"]] == ["press", "pour"]
        assert listed["last"] == "open is unloaded"
        series = get(server, "/metrics")[1].splitlines()
        assert any('request_seconds_count{adapter="pour"}' in line for line in series)


@pytest.mark.parametrize(
    ("values", "refusal"),
    [
        ({"name": "press", "remove": True}, "answers requests that name no adapter"),
        ({"name": "dance", "remove": True}, "one of press, pour, open, got 'dance'"),
        ({"name": "a/b", "path": "x"}, "name must match"),
        ({"name": "a", "path": "nowhere"}, "there is no folder nowhere"),
        ({"name": "a", "path": "x" * 5000}, "File name too long"),
        ({"name": "a"}, "the body must be JSON"),
        ({"name": "a", "path": "x", "remove": True}, "the body must be JSON"),
        (b"{", "the body must be JSON"),
        (b" " * 2**17, "the body must be JSON"),
    ],
)
def test_posts_that_are_refused_change_nothing(values, refusal, served):
    before = served.instructions
    with serving(served, token="secret") as server:
        status, text = post(server, values)
        assert (status, refusal in text) == (400, True), text
    assert served.instructions == before


def test_settings_of_training_and_processing_are_not_of_the_base(finished, runs, tmp_path):
    """They were part of it once, which then was in memory twice, and refused by POST."""
    delta = (True,) * 6 + (False,)
    inputs = dataclasses.asdict(Pi0Config.dummy().inputs) | {"delta": delta}
    config = {"remat": "full", "unroll": False, "inputs": inputs}
    other = write_run(finished.folder, tmp_path / "other", 5, config=config)
    served = serve_runs({"press": runs["press"], "other": other}, max_batch=1)
    served.put("posted", other)
    press, *others = (each.policy.policy for each in served.adapters)
    assert all(each.processor.inputs.delta == delta for each in others)
    for each in others:
        assert [*map(id, each.model.base)] == [*map(id, press.model.base)]
    alone = serve_runs({"other": other}, share=False, max_batch=1)
    sent = request(served.spec, 0, TEXTS["press"][0])
    expected = actions(alone, sent)
    sent = dataclasses.replace(sent, adapter="posted")
    np.testing.assert_allclose(actions(served, sent), expected, atol=ROUNDING)


def test_adapters_of_another_robot_are_refused(finished, runs, tmp_path, capsys):
    from lorasp_jax.extras.serving import export as exporting

    other = write_run(finished.folder, tmp_path / "other", 5, robot="panda")
    served = serve_runs({"press": runs["press"]}, max_batch=1)
    for name in ("other", "press"):  # also in place of the default
        with pytest.raises(ValueError, match=r"present press and .* together: their metadata"):
            served.put(name, other)
    words = [runs["press"], f"other={other}", "--out", str(tmp_path / "policy")]
    assert exporting.main(words) == 2
    assert "press and other cannot be served together" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "policy").exists()


def test_quantized_bases_are_shared_only_with_equal_digests(finished, runs, tmp_path):
    """Quantized kernels have no fingerprints that could tell them apart."""
    paths = {n: write_run(finished.folder, tmp_path / n, 1, quantized="nf4") for n in "abc"}
    for name, digest in {"a": "one", "b": "one", "c": "two"}.items():
        rewrite(Path(paths[name]), base=digest)
    a, b, c = (
        [*map(id, each.policy.policy.model.base)]
        for each in serve_runs(paths, max_batch=1).adapters
    )
    assert a == b
    assert not {*a} & {*c}


def test_whether_a_run_can_share_is_asked_of_a_base_that_has_moved(finished, tmp_path, dummy_base):
    run = write_run(finished.folder, tmp_path / "run", 1, base="")
    with pytest.raises(ValueError, match="randomly initialized"):
        Bases.can_share(run)
    assert Bases.can_share(run, str(dummy_base))


def test_posts_need_the_token_of_a_server_that_has_one(served, runs):
    values = {"name": "more", "path": runs["press"]}
    with serving(served, token="secret") as server:
        assert post(server, values, token="wrong")[0] == 401
    with serving(served) as server:
        status, text = post(server, values)
        assert (status, "--token-file" in text) == (403, True)
    assert "more" not in served.instructions


def test_an_adapter_of_another_base_is_refused(served, foreign, runs, tmp_path):
    with pytest.raises(ValueError, match="was trained on another base than those of this server"):
        served.put("foreign", foreign)
    both = serve_runs({"press": runs["press"], "foreign": foreign}, max_batch=1)
    models_of_both = [each.policy.policy.model for each in both.adapters]
    assert not {map(id, models_of_both[0].base)} & {map(id, models_of_both[1].base)}
    bare = export.load_policy(runs["press"]).model
    folder = tmp_path / "without"
    native.save_adapters(folder, bare, metadata=export.describe(runs["press"]))
    rewrite(folder, weights={})
    with pytest.raises(ValueError, match="has no fingerprints of its base"):
        served.put("without", str(folder))


def rewrite(folder, **fields):
    """Change adapter.json, and its digest."""
    from lorasp_jax.base import digest

    description = native.read_description(folder) | fields
    description |= {"format": native.FORMAT, "version": native.VERSION}
    (folder / native.DESCRIPTION).write_text(json.dumps(digest.with_digest(description)))


def test_a_bundle_holds_the_base_once_and_acts_alike(served, runs, tmp_path, capsys):
    from lorasp_jax.extras.serving import export as exporting

    out, words = tmp_path / "policy", ["--denoise-steps", "2", "--max-batch", "1"]
    named = [f"{name}={run}" for name, run in runs.items()]
    assert exporting.main([*named, "--out", str(out), *words]) == 0
    assert "wrote" in capsys.readouterr().out
    one = tmp_path / "one"
    assert exporting.main([runs["press"], "--out", str(one), *words]) == 0
    size = lambda folder: sum(f.stat().st_size for f in folder.rglob("*.safetensors"))  # noqa: E731
    own = sum(array.nbytes for array in served.adapters[0].policy.policy.model.own)
    assert size(out) < size(one) + 2.5 * own, "three adapters and one base"
    assert len([*out.glob("program-*.bin")]) == 1, "equal programs are stored once"
    bundle = command._load(
        command.parser("serve").parse_args([str(out), "--seed", "0"]), Console(quiet=True)
    )
    assert bundle.instructions == served.instructions
    for name in runs:
        expected = actions(served, asked(served, name))
        np.testing.assert_allclose(actions(bundle, asked(bundle, name)), expected, atol=ROUNDING)
    arrays = [each.policy._weights for each in bundle.adapters]
    ids = [{id(array) for array in each} for each in arrays]
    names = json.loads((out / "pour" / "policy.json").read_text())["weights"]
    assert len(ids[0] & ids[1] & ids[2]) == sum(name.startswith("base/") for name in names) > 50
    alone = exported.load(out / "pour")
    assert alone.instructions == TEXTS["pour"]
    (out / "base.safetensors").write_bytes(b"x" + (out / "base.safetensors").read_bytes()[1:])
    with pytest.raises(ValueError, match=r"base.* is missing or damaged"):
        exported.load_bundle(out)


def test_runs_of_different_bases_make_no_bundle(runs, foreign, tmp_path, capsys):
    from lorasp_jax.extras.serving import export as exporting

    words = [runs["press"], f"foreign={foreign}", "--out", str(tmp_path / "x")]
    assert exporting.main(words) == 2
    assert "trained on another base" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "x").exists()


def test_a_checkpoint_shares_its_base_with_its_adapters(dummy_base, tmp_path):
    rules = [("q_proj", LoRA(rank=2))]
    adapted = lorasp_jax.adapt(models.load(dummy_base), rules, rngs=nnx.Rngs(0))
    native.save_adapters(tmp_path / "a", adapted)
    words = [str(dummy_base), "--adapter", f"a={tmp_path / 'a'}", "--max-batch", "1", "--seed", "0"]
    served = command._load(
        command.parser("serve").parse_args([*words, "--denoise-steps", "1"]), Console(quiet=True)
    )
    served.put("b", str(tmp_path / "a"))
    base, a, b = (each.policy.policy.model for each in served.adapters)
    assert len(base.own) == 0 < len(a.own) == len(b.own)
    assert [*map(id, base.base)] == [*map(id, a.base)] == [*map(id, b.base)]
    with pytest.raises(ValueError, match=r"nowhere/adapter.json is missing"):
        served.put("c", "nowhere")


@pytest.mark.parametrize("method", [LoRA(rank=2), DoRA(rank=2)], ids=["LoRA", "DoRA"])
def test_a_checkpoint_takes_the_same_adapters_by_post_as_at_start(method, dummy_base, tmp_path):
    """Also those of PEFT, although the model is no longer at hand."""
    graphdef, adapters, frozen = lorasp_jax.split(
        lorasp_jax.adapt(models.load(dummy_base), [("q_proj", method)], rngs=nnx.Rngs(0))
    )
    adapted = nnx.merge(graphdef, with_noise(adapters, 0.1), frozen)
    folder = str(tmp_path / "theirs")
    lorasp_jax.save_peft(folder, adapted, names=models.lerobot_names(adapted))
    words = [str(dummy_base), "--adapter", f"a={folder}", "--max-batch", "1", "--seed", "0"]
    served = command._load(
        command.parser("serve").parse_args([*words, "--denoise-steps", "1"]), Console(quiet=True)
    )
    served.put("b", folder)
    _, a, b = (each.policy.policy.model for each in served.adapters)
    assert a.structure is b.structure
    for ours, theirs in zip(a.own, b.own, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_server_with_weights_of_its_own_loads_no_adapters(runs):
    own = serve_runs({"press": runs["press"]}, share=False)
    with pytest.raises(ValueError, match="--adapters-on-device"):
        own.put("pour", runs["pour"])
