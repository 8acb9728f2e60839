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

from lorasp_jax.extras.serving import exported
from lorasp_jax.extras.serving.exporting import write
from tests import ROOT
from tests.extras.serving.test_policies import INSTRUCTIONS, make_policy

STEPS = 2
MODULES = "import sys; print(*sys.modules)"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("exports") / "policy"
    write(make_policy(), folder, continues=True, num_steps=STEPS, max_batch=2)
    return folder


@pytest.fixture(scope="module")
def loaded(folder):
    return exported.load(folder)


@pytest.fixture
def copy(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "copy")


def arguments(loaded, seed=0, **changes):
    rng, needs = np.random.default_rng(seed), loaded.description
    shape = (needs.image_size, needs.image_size, 3)
    given = {
        "images": {name: rng.integers(0, 255, shape, np.uint8) for name in needs.cameras},
        "state": rng.normal(size=needs.state_dim).astype(np.float32),
        "instruction": loaded.instructions[0],
        "noise": rng.standard_normal(loaded.noise_shape, np.float32),
    }
    return given | changes


def in_process(policy, given, *, absent=(), **condition):
    """Actions of the policy itself; `prefix` is in the robot's units."""
    state = given["state"][None]
    raw = {"image": {name: image[None] for name, image in given["images"].items()}, "state": state}
    row = policy.processor.prompts.rows([given["instruction"]])
    encoded = policy.processor.encode(raw, row)
    if absent:
        masks = {name: np.array([name not in absent]) for name in raw["image"]}
        images = {n: i if n not in absent else 0 * i - 1 for n, i in encoded.images.items()}
        encoded = dataclasses.replace(encoded, images=images, image_masks=masks)
    if condition:
        prefix = policy.processor.normalize_actions(condition["prefix"][None], state)
        condition |= {"prefix": prefix}
    chunk = policy.model.sample_actions(
        None,
        encoded,
        num_steps=STEPS,
        noise=given["noise"][None],
        slots=policy.processor.flow_slots,
        **condition,
    )
    return np.asarray(policy.processor.decode(chunk, state))[0]


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


def test_a_camera_may_be_absent(loaded):
    given = arguments(loaded)
    expected = in_process(make_policy(), given, absent=["wrist"])
    images = {"side": given["images"]["side"]}
    np.testing.assert_allclose(loaded.act(**given | {"images": images}), expected, atol=1e-5)
    assert np.abs(loaded.act(**given) - expected).max() > 1e-3


def test_everything_given_matters(loaded):
    given, other = arguments(loaded), arguments(loaded, seed=1, instruction=INSTRUCTIONS[1])
    first = loaded.act(**given)
    for name, value in other.items():
        assert np.abs(loaded.act(**given | {name: value}) - first).max() > 1e-3, name


def test_a_batch_gives_the_actions_of_its_rows(loaded):
    rows = [arguments(loaded, seed) for seed in (0, 1)]
    together = loaded.run([loaded.row(**row) for row in rows])
    for row, actions in zip(rows, together, strict=True):
        np.testing.assert_allclose(actions, loaded.act(**row), atol=1e-5)
    with pytest.raises(ValueError, match="runs batches of 1, 2 observations, got 3"):
        loaded.run([loaded.row(**rows[0])] * 3)


def test_a_chunk_continues_the_previous_one(loaded):
    rest = loaded.act(**arguments(loaded))[1:]
    given = arguments(loaded, seed=1)
    actions = loaded.act(**given, previous=rest, delay=2)
    np.testing.assert_allclose(actions[:2], rest[:2], atol=1e-5)
    expected = in_process(make_policy(), given, prefix=rest, prefix_length=2)
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    nothing = loaded.act(**given, previous=rest[:0])
    np.testing.assert_allclose(nothing, loaded.act(**given), atol=1e-5)


def test_weights_and_statistics_are_data(tmp_path):
    """Programs do not depend on the weights: other weights make them another policy."""
    other = make_policy(seed=1)
    statistics = jax.tree.map(lambda a: a * 1.5, other.processor.statistics)
    processor = dataclasses.replace(other.processor, statistics=statistics)
    other = dataclasses.replace(other, processor=processor)
    for name, policy in {"first": make_policy(), "other": other}.items():
        write(policy, tmp_path / name, num_steps=STEPS, max_batch=1)
    first, second = (tmp_path / name for name in ("first", "other"))
    assert (first / "act-1.bin").read_bytes() == (second / "act-1.bin").read_bytes()
    for name in ("weights.safetensors", "processor.json"):
        shutil.copy(second / name, first / name)
    resign(first)
    changed = exported.load(first)
    given = arguments(changed)
    np.testing.assert_allclose(changed.act(**given), in_process(other, given), atol=1e-5)


def test_programs_are_portable(folder):
    for path in folder.glob("*.bin"):
        program = jax.export.deserialize(bytearray(path.read_bytes()))
        assert program.platforms == ("cpu", "cuda")
        assert "custom_call" not in program.mlir_module()
        assert b"/lorasp_jax" not in path.read_bytes()
        assert str(ROOT).encode() not in path.read_bytes()


def test_only_weights_in_use_are_stored(folder):
    names = exported.load(folder)._weights
    backbone = sum(leaf.nbytes for leaf in jax.tree.leaves(make_policy().model))
    assert sum(array.nbytes for array in names) < 1.05 * backbone


def test_the_loader_imports_nothing_else_of_the_package():
    code = f"import lorasp_jax.extras.serving.exported; {MODULES}"
    modules = subprocess.check_output([sys.executable, "-c", code], cwd=ROOT, text=True).split()
    ours = {name for name in modules if name.partition(".")[0] in ("lorasp_jax", "envs")}
    assert ours == {"lorasp_jax", "lorasp_jax.extras.serving", "lorasp_jax.extras.serving.exported"}


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
    ("changes", "sentence"),
    [
        ({"images": {}}, "images must be those of the cameras side, wrist, got none"),
        ({"images": {"top": 0}}, "images must be those of the cameras side, wrist, got top"),
        ({"images": {"side": np.zeros((32, 32, 3))}}, r"image of side must be uint8 \[32, 32, 3\]"),
        ({"images": {"side": np.zeros((9, 9, 3), np.uint8)}}, r"got uint8 \[9, 9, 3\]"),
        ({"state": np.zeros(7)}, r"state must be float32 \[7\], got float64 \[7\]"),
        ({"state": [0.0] * 7}, r"state must be float32 \[7\], got list"),
        ({"state": np.full(7, np.nan, np.float32)}, "state must be finite"),
        ({"noise": np.zeros((4, 7), np.float32)}, r"noise must be float32 \[4, 8\], got float32"),
        ({"instruction": "dance"}, "instruction must be one of 'press the button', 'push the but"),
        ({"delay": 1}, "delay 1 was given without previous"),
        ({"previous": np.zeros((5, 7), np.float32)}, r"previous must be float32 \[4, 7\], got "),
        ({"previous": np.zeros(7, np.float32)}, r"previous must be float32 \[4, 7\], got "),
        ({"previous": np.zeros((2, 7), np.float32), "delay": 3}, "delay must be .* from 0 to 2"),
        ({"previous": np.zeros((2, 7), np.float32), "delay": 0.5}, "delay must be an integer"),
    ],
)
def test_inputs_that_do_not_fit(loaded, changes, sentence):
    with pytest.raises(ValueError, match=sentence):
        loaded.act(**arguments(loaded, **changes))


def test_long_lists_of_instructions_are_shortened(loaded):
    tokens = loaded._tokens[INSTRUCTIONS[0]]
    many = exported.ExportedPolicy(
        loaded.description, {}, [], {}, {f"go to {i}": tokens for i in range(12)}
    )
    with pytest.raises(ValueError, match="'go to 9' and 2 others, got 'dance'"):
        many.row(**arguments(many, instruction="dance"))


def test_policies_that_cannot_do_it(copy):
    def change(values):
        values["policy"] |= {"continues": False, "masks_missing": False}

    resign(copy, change)
    loaded = exported.load(copy)
    given = arguments(loaded)
    with pytest.raises(ValueError, match="not trained to continue chunks"):
        loaded.act(**given, previous=np.zeros((4, 7), np.float32))
    with pytest.raises(
        ValueError, match="images must be those of the cameras side, wrist, got sid"
    ):
        loaded.act(**given | {"images": {"side": given["images"]["side"]}})


def test_every_damaged_or_missing_file_is_named(folder, copy):
    for path in sorted(folder.iterdir()):
        damaged = bytearray(path.read_bytes())
        damaged[len(damaged) // 2] ^= 1
        (copy / path.name).write_bytes(damaged)
        with pytest.raises(ValueError, match=rf"{path.name} is damaged: copy the folder or export"):
            exported.load(copy)
        (copy / path.name).unlink()
        with pytest.raises(ValueError, match=rf"(lacks {path.name}|{path.name} is missing)"):
            exported.load(copy)
        shutil.copy(path, copy)
    assert exported.load(copy).instructions == INSTRUCTIONS


@pytest.mark.parametrize("text", ["", "[]", "{}", "[" * 100_000, '{"format": 1, "digest": 3}'])
def test_a_description_that_is_none(copy, text):
    (copy / "policy.json").write_text(text)
    with pytest.raises(ValueError, match="is damaged"):
        exported.load(copy)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"format": 2}, "has format 2, but this version of the code reads format 1: export"),
        (
            {"jax": [99, 0, 0]},
            r"exported with JAX 99\.0\.0, which JAX .* cannot run: install JAX 99",
        ),
        ({"calling_convention": 0}, "cannot run: install JAX"),
        ({"platforms": ["cuda"]}, "exported for cuda, but JAX uses cpu here"),
    ],
)
def test_folders_for_something_else(copy, changes, sentence):
    resign(copy, lambda values: values.update(changes))
    with pytest.raises(ValueError, match=sentence):
        exported.load(copy)


def test_platforms_have_the_names_of_exported_programs(monkeypatch):
    client = dataclasses.make_dataclass("Client", ["platform_version"])
    device = dataclasses.make_dataclass("Device", ["platform", "client"])
    for platform, version, expected in (
        ("cpu", "cpu", "cpu"),
        ("gpu", "PJRT C API\ncuda 13000", "cuda"),
        ("gpu", "PJRT C API\nrocm 70000", "rocm"),
        ("tpu", "PJRT C API\nTFRT TPU v5", "tpu"),
    ):
        monkeypatch.setattr(jax, "devices", lambda p=platform, v=version: [device(p, client(v))])
        assert exported._platform() == expected


def test_kernels_run_at_once_only_where_xla_knows_the_option(monkeypatch):
    assert exported.sampling_options() is None
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    for version, known in [((0, 10, 2), False), ((0, 11, 2), True)]:
        monkeypatch.setattr(jax, "__version_info__", version)
        assert bool(exported.sampling_options()) is known
