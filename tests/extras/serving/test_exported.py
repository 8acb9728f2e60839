"""Test that exported policies act like the policy, anywhere, and are refused where they cannot."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys

import jax
import numpy as np
import pytest
from rich.console import Console

from lorasp_jax.extras.serving import __main__ as command
from lorasp_jax.extras.serving import exported
from lorasp_jax.extras.serving.exporting import write
from lorasp_jax.extras.serving.requests import Request
from lorasp_jax.extras.serving.served import ServedPolicies
from tests import ROOT
from tests.extras.serving.conftest import ROBOT
from tests.extras.serving.stand_in import connect, observation, serving
from tests.extras.serving.test_policies import (
    INSTRUCTIONS,
    STEPS,
    actions,
    compiled,
    make_policy,
    reference,
    request,
)

MODULES = "import sys; print(*sys.modules)"


@pytest.fixture
def copy(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "copy")


def arguments(loaded, seed=0, **changes):
    noise = np.random.default_rng(seed).standard_normal(loaded.noise_shape, np.float32)
    sent = request(loaded.description, seed, prompt=loaded.instructions[0])
    given = {"images": sent.images, "state": sent.state, "instruction": sent.prompt, "noise": noise}
    return given | changes


def in_process(policy, given, **condition):
    """Actions of the policy itself; `prefix` is in the robot's units."""
    sent = Request(given["images"], given["state"], given["instruction"])
    return reference(policy, [sent], given["noise"][None], **condition)[0]


def resign(folder, change=lambda values: None):
    """Change policy.json and renew all digests."""
    path = folder / "policy.json"
    values = json.loads(path.read_text())
    values["files"] = {name: exported.file_digest(folder / name) for name in values["files"]}
    change(values)
    del values["digest"]
    path.write_text(json.dumps(values | {"digest": exported.digest(values)}))


def test_actions_are_those_of_the_policy(loaded):
    given = arguments(loaded)
    actions = loaded.act(**given)
    assert (actions.shape, actions.dtype) == ((4, 7), np.float32)
    np.testing.assert_allclose(actions, in_process(make_policy(), given), atol=1e-5)
    expected = in_process(make_policy(), given, absent=["wrist"])
    images = {"side": given["images"]["side"]}
    np.testing.assert_allclose(loaded.act(**given | {"images": images}), expected, atol=1e-5)
    assert np.abs(actions - expected).max() > 1e-3


def test_a_chunk_continues_the_previous_one(loaded):
    rest = loaded.act(**arguments(loaded))[1:]
    given = arguments(loaded, seed=1)
    actions = loaded.act(**given, previous=rest, delay=2)
    np.testing.assert_allclose(actions[:2], rest[:2], atol=1e-5)
    expected = in_process(make_policy(), given, prefix=rest[None], prefix_length=2, guidance=None)
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    nothing = loaded.act(**given, previous=rest[:0])
    np.testing.assert_allclose(nothing, loaded.act(**given), atol=1e-5)


def test_served_exports_act_like_served_runs(loaded, other_folder):
    """With the noise of the same seed, alone and in batches."""
    exports = {"base": loaded, "other": exported.load(other_folder)}
    runs = {"base": make_policy(), "other": make_policy(seed=1)}
    served, expected = ServedPolicies(exports, seed=3), compiled(runs, seed=3, metadata=ROBOT)
    assert served.spec == expected.spec
    assert served.instructions == expected.instructions
    assert (served.sizes, served.metadata) == ((1,), ROBOT)
    asked = request(served.spec, absent=["wrist"], adapter="other")
    found = [actions(each, asked, index=(2, 5)) for each in (served, expected)]
    np.testing.assert_allclose(*found, atol=1e-5)
    two = [request(served.spec), request(served.spec, 1, INSTRUCTIONS[0])]
    both = actions(served, *two)
    alone = [actions(expected, each)[0] for each in two]
    np.testing.assert_allclose(both, alone, atol=1e-5)


def test_served_exports_continue_chunks(loaded):
    served = ServedPolicies({"base": loaded}, execution="trained")
    first = request(served.spec)
    previous = actions(served, first)[0]
    naive = ServedPolicies({"base": loaded})
    independent = actions(naive, first)[0]
    np.testing.assert_allclose(previous, independent, atol=1e-5)
    second = dataclasses.replace(first, previous=previous, executed=1, delay=2)
    found = actions(served, second, index=(0, 1))[0]
    np.testing.assert_allclose(found[:2], previous[1:3], atol=1e-5)
    assert np.abs(found[2] - independent[2]).max() > 1e-4


def load(*words):
    return command._load(command.parser("serve").parse_args(words), Console(quiet=True))


def test_a_server_of_exported_policies(other_folder):
    policy = load(str(other_folder), "--prompt", "push the button")
    with serving(policy) as server, connect(server) as client:
        assert client.metadata["robot"] == "piper"
        sent = observation(policy.spec)
        del sent["prompt"]
        assert client.infer(sent)["actions"].shape == (4, 7)
        with pytest.raises(Exception, match="one of 'press the button', 'push the button'"):
            client.infer(sent | {"prompt": "dance"})


@pytest.mark.parametrize(
    ("words", "refusal"),
    [
        (["--denoise-steps", "5"], "--denoise-steps"),
        (["--max-batch", "2"], "--max-batch"),
        (["--base", "x"], "--base"),
        (["--joints", "6"], "--joints"),
        (["--execution", "guided"], "cannot be guided"),
        (["--execution", "trained"], "other was not trained to continue"),
        (["assets/pi0_nano"], "several policies"),
    ],
)
def test_what_exported_policies_cannot_do(other_folder, words, refusal):
    with pytest.raises(ValueError, match=refusal):
        load(str(other_folder), *words)


def test_policies_of_different_robots_are_not_served_together(loaded):
    needs = dataclasses.replace(loaded.description, metadata={"robot": "panda"})
    other = exported.ExportedPolicy(needs, {}, [], {}, {})
    with pytest.raises(ValueError, match="cannot be served together: their metadata"):
        ServedPolicies({"base": loaded, "panda": other})


def test_weights_and_statistics_are_data(folder, other_folder, copy):
    """Programs do not depend on the weights: other weights make them another policy."""
    assert (folder / "act-1.bin").read_bytes() == (other_folder / "act-1.bin").read_bytes()
    for name in ("weights.safetensors", "processor.json"):
        shutil.copy(other_folder / name, copy / name)
    resign(copy)
    changed = exported.load(copy)
    given = arguments(changed)
    np.testing.assert_allclose(
        changed.act(**given), in_process(make_policy(seed=1), given), atol=1e-5
    )


def test_programs_are_portable(folder, loaded):
    for path in folder.glob("*.bin"):
        program = jax.export.deserialize(bytearray(path.read_bytes()))
        assert program.platforms == ("cpu", "cuda")
        assert "custom_call" not in program.mlir_module()
        assert not any(name in path.read_bytes() for name in (b"/lorasp_jax", str(ROOT).encode()))
    backbone = sum(leaf.nbytes for leaf in jax.tree.leaves(make_policy().model))
    assert sum(array.nbytes for array in loaded._weights) < 1.05 * backbone  # those in use


def test_the_loader_imports_nothing_else_of_the_package():
    code = f"import lorasp_jax.extras.serving.exported; {MODULES}"
    modules = subprocess.check_output([sys.executable, "-c", code], cwd=ROOT, text=True).split()
    ours = {name for name in modules if name.partition(".")[0] in ("lorasp_jax", "envs")}
    packages = {"lorasp_jax", "lorasp_jax.extras", "lorasp_jax.extras.serving"}
    assert ours == {*packages, "lorasp_jax.extras.serving.exported"}


@pytest.mark.slow
def test_the_client_of_the_documentation_runs_without_the_package(folder, tmp_path):
    page = (ROOT / "docs" / "serving.md").read_text()
    (client,) = re.findall(r"^```py\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    shutil.copytree(folder, tmp_path / "policy")
    shutil.copy(exported.__file__, tmp_path)
    code = f"{client}\nprint(*actions.shape)\n{MODULES}"
    printed = subprocess.check_output([sys.executable, "-c", code], cwd=tmp_path, text=True)
    shape, modules = printed.splitlines()
    assert shape == "4 7"
    packages = {name.partition(".")[0] for name in modules.split()}
    assert packages.isdisjoint({"lorasp_jax", "envs", "flax", "mujoco", "orbax", "optax", "PIL"})
    assert len([line for line in client.splitlines() if line and line[0] != "#"]) <= 10


@pytest.mark.parametrize(
    ("changes", "refusal"),
    [
        ({"images": {}}, "cameras side, wrist, got none"),
        ({"images": {"top": 0}}, "cameras side, wrist, got top"),
        ({"images": {"side": np.zeros((32, 32, 3))}}, r"image of side must be uint8 \[32, 32, 3\]"),
        ({"images": {"side": np.zeros((9, 9, 3), np.uint8)}}, r"got uint8 \[9, 9, 3\]"),
        ({"state": np.zeros(7)}, r"state must be float32 \[7\], got float64 \[7\]"),
        ({"state": [0.0] * 7}, r"state must be float32 \[7\], got list"),
        ({"state": np.full(7, np.nan, np.float32)}, "state must be finite"),
        ({"noise": np.zeros((4, 7), np.float32)}, r"noise must be float32 \[4, 8\]"),
        ({"instruction": "dance"}, "one of 'press the button', 'push the button', got 'dance'"),
        ({"delay": 1}, "delay 1 was given without previous"),
        ({"previous": np.zeros((5, 7), np.float32)}, r"previous must be float32 \[4, 7\]"),
        ({"previous": np.zeros(7, np.float32)}, r"previous must be float32 \[4, 7\]"),
        ({"previous": np.zeros((2, 7), np.float32), "delay": 3}, "delay .* from 0 to 2"),
        ({"previous": np.zeros((2, 7), np.float32), "delay": 0.5}, "delay must be an integer"),
    ],
)
def test_inputs_that_do_not_fit(loaded, changes, refusal):
    with pytest.raises(ValueError, match=refusal):
        loaded.act(**arguments(loaded, **changes))


def test_policies_that_cannot_do_it(other_folder, tmp_path):
    copy = shutil.copytree(other_folder, tmp_path / "copy")
    resign(copy, lambda values: values["policy"].update(masks_missing=False))
    loaded = exported.load(copy)
    given = arguments(loaded)
    with pytest.raises(ValueError, match="not trained to continue chunks"):
        loaded.act(**given, previous=np.zeros((4, 7), np.float32))
    with pytest.raises(ValueError, match="cameras side, wrist, got side"):
        loaded.act(**given | {"images": {"side": given["images"]["side"]}})


def test_every_damaged_or_missing_file_is_named(folder, copy):
    for path in sorted(folder.iterdir()):
        damaged = bytearray(path.read_bytes())
        damaged[len(damaged) // 2] ^= 1
        (copy / path.name).write_bytes(damaged)
        with pytest.raises(ValueError, match=rf"{path.name} is .*damaged"):
            exported.load(copy)
        (copy / path.name).unlink()
        with pytest.raises(ValueError, match=rf"(lacks {path.name}|{path.name} is missing)"):
            exported.load(copy)
        shutil.copy(path, copy)
    assert exported.load(copy).instructions == INSTRUCTIONS


@pytest.mark.parametrize(
    ("text", "refusal"),
    [
        *((text, "is damaged") for text in ("", "[]", "{}", "[" * 100_000, '{"format": 1}')),
        ('{"format": 2}', "has format 2"),
    ],
)
def test_a_description_that_is_none(copy, text, refusal):
    (copy / "policy.json").write_text(text)
    with pytest.raises(ValueError, match=refusal):
        exported.load(copy)


def test_folders_of_a_newer_jax(copy):
    resign(copy, lambda values: values.update(jax=[99, 0, 0]))
    with pytest.raises(ValueError, match=r"install JAX 99\.0\.0"):
        exported.load(copy)


def test_kernels_run_at_once_only_where_xla_knows_the_option(monkeypatch):
    assert exported.sampling_options() is None
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    for version, known in [((0, 10, 2), False), ((0, 11, 2), True)]:
        monkeypatch.setattr(jax, "__version_info__", version)
        assert bool(exported.sampling_options()) is known


def test_actions_may_be_shorter_than_states(tmp_path):
    policy = make_policy(action_dims=6)
    write(policy, tmp_path / "short", continues=True, num_steps=STEPS, max_batch=1)
    loaded = exported.load(tmp_path / "short")
    given = arguments(loaded)
    actions = loaded.act(**given)
    assert actions.shape == (loaded.description.chunk, 6)
    np.testing.assert_allclose(actions, in_process(policy, given), atol=1e-5)
    continued = loaded.act(**given, previous=actions[1:], delay=1)
    np.testing.assert_allclose(continued[0], actions[1], atol=1e-5)
    with pytest.raises(ValueError, match=r"previous must be float32 \[\d, 6\]"):
        loaded.act(**given, previous=np.zeros((2, 7), np.float32))


def test_older_exports_have_actions_as_long_as_states(copy):
    resign(copy, lambda values: values["policy"].pop("action_length"))
    assert exported.load(copy).description.action_length == 7
