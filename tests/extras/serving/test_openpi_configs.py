"""Test that a served checkpoint of openpi sees and answers what openpi's own server does."""

import dataclasses
import json
import re
from typing import Any

import jax
import numpy as np
import pytest
from safetensors.numpy import save_file

from lorasp_jax import models
from lorasp_jax.extras.serving import __main__ as command
from lorasp_jax.extras.serving import loading, policies, requests, server
from lorasp_jax.extras.serving.policies import CompiledPolicy
from lorasp_jax.extras.serving.served import ServedPolicies
from lorasp_jax.models.checkpoints import loading as checkpoints
from lorasp_jax.models.checkpoints import openpi_configs, published
from lorasp_jax.models.inputs import OPENPI
from lorasp_jax.models.pi0 import Pi0Config
from tests import ROOT
from tests.extras.serving import openpi_requests
from tests.extras.serving.test_policies import actions, prepared
from tests.models.random_models import random_backbone

GOLDEN = ROOT / "tests" / "golden"
WORDS = str(GOLDEN / "tokenizers" / "paligemma_like.model")
EXPECTED = np.load(GOLDEN / "openpi_configs.npz")
NAMES = list(dict.fromkeys(key.partition("/")[0] for key in EXPECTED))
LIBERO = [openpi_requests.statistics(0, 8), openpi_requests.statistics(2, 7)]


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True, eq=False)
class Echo:
    """Answers with the noise, and keeps what it saw."""

    config: Any
    seen: list = dataclasses.field(default_factory=list)

    def sampler(self):
        return self

    def sample_actions(self, key, observation, *, noise, **options):
        self.seen.append((observation, options["slots"]))
        return noise, (None, None)


def checkpoint(folder, stats):
    """Make a folder look like a checkpoint of openpi, without weights."""
    for name, (state, action) in stats.items():
        assets = folder / "assets" / name
        assets.mkdir(parents=True)
        text = json.dumps({"norm_stats": {"state": state, "actions": action}})
        (assets / "norm_stats.json").write_text(text)
    (folder / "params").mkdir()
    (folder / "params" / "_METADATA").write_text("{}")
    return folder


def conversion(folder, *, chunk, tensor):
    """Make a folder look like openpi's PyTorch conversion, with one tensor."""
    checkpoint(folder, {"libero": LIBERO})
    (folder / "params" / "_METADATA").unlink()
    fields = {"action_dim": 32, "action_horizon": chunk, "paligemma_variant": "gemma_2b"}
    (folder / "config.json").write_text(json.dumps(fields))
    save_file({tensor: np.zeros(1)}, folder / "model.safetensors")
    return folder


@pytest.fixture
def echo(monkeypatch):
    monkeypatch.setattr(checkpoints.ModelFolder, "load", lambda _, config=None: Echo(config))


def test_the_table_is_of_the_configs_that_were_compared():
    assert [*openpi_configs.CONFIGS] == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_served_like_openpi(name, tmp_path, echo):
    """State, prompt, pictures, training targets and actions, for statistics as long as states."""
    number, named = NAMES.index(name), openpi_configs.find(name)
    robot = next(each for each in ("libero", "droid", "aloha") if each in name)
    lengths = named.robot.state_dim, named.robot.action_length
    stats = [
        openpi_requests.statistics(s + number, n) for s, n in zip((0, 2), lengths, strict=True)
    ]
    folder = checkpoint(tmp_path / name, {"any": stats})
    loaded = loading.load_checkpoint(str(folder), tokenizer=WORDS)["base"]
    served = ServedPolicies({"base": CompiledPolicy(loaded, max_batch=1)})
    cameras = 1 if "sim" in name else 2 if "towel" in name else 3
    message = openpi_requests.request(robot, number, cameras, prompt=not named.prompt)
    row = prepared(served, requests.parse(message, served.spec))
    row.pop("index")

    expected = {key: EXPECTED[f"{name}/{key}"] for key in ("state", "targets", "actions")}
    noise = openpi_requests.chunk(5 + number, len(expected["actions"]), 32)
    assert (served.spec.chunk, served.spec.action_length) == expected["actions"].shape
    policy = loaded.policy
    batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], {**row, "noise": noise})
    actions = policies.sample(policy, batch, num_steps=1)[0]
    observation, slots = policy.model.seen[-1]
    assert slots.all()

    np.testing.assert_allclose(observation.state[0], expected["state"], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(actions, expected["actions"], rtol=1e-6, atol=1e-6)
    mask = EXPECTED[f"{name}/token_mask"]
    np.testing.assert_array_equal(observation.token_mask[0], mask)
    np.testing.assert_array_equal(
        np.where(mask, observation.tokens[0], 0), EXPECTED[f"{name}/tokens"]
    )
    masks = [bool(observation.image_masks[camera][0]) for camera in policy.model.config.cameras]
    assert masks == EXPECTED[f"{name}/masks"].tolist()
    pictures = zip(policy.model.config.cameras, EXPECTED[f"{name}/pictures"], strict=True)
    for camera, picture in pictures:
        seen = (np.asarray(observation.images[camera][0]) + 1) * 127.5
        np.testing.assert_allclose(seen[3::14, 5::14], picture, atol=1e-4)

    absolute = 0.8 * openpi_requests.wave(3 + number, *expected["actions"].shape)
    targets = loaded.policy.processor.normalize_actions(absolute.astype("f"), row["state"])
    np.testing.assert_allclose(targets, expected["targets"], rtol=1e-6, atol=2e-6)


@pytest.mark.parametrize(
    ("options", "refusal"),
    [
        ({}, r"(?s)--openpi-config .*pi05_libero.*--size, --chunk, --relative$"),
        ({"size": "base_pi05", "chunk": 10, "relative": ()}, "--prompt-state$"),
        ({"size": "base", "relative": ()}, "else --chunk$"),
        ({"size": "huge", "chunk": 10, "relative": ()}, "unknown size 'huge'"),
        ({"openpi_config": "pi0_fast_droid"}, "unknown training config 'pi0_fast_droid'"),
        ({"openpi_config": "pi0_libero", "size": "base_pi05"}, "training config is of pi0:"),
    ],
)
def test_what_the_files_do_not_say_is_asked(options, refusal, tmp_path, echo, capsys):
    folder = checkpoint(tmp_path / "mine", {"libero": LIBERO})
    with pytest.raises(ValueError, match=refusal):
        loading.load_checkpoint(str(folder), tokenizer=WORDS, **options)
    assert not capsys.readouterr().err


def test_options_win_over_the_training_config(tmp_path, echo, capsys):
    """A folder of openpi's training is named checkpoints/CONFIG/EXPERIMENT/STEP."""
    folder = checkpoint(tmp_path / "pi05_libero" / "mine" / "29999", {"libero": LIBERO})
    given: Any = {"chunk": 20, "relative": (0, 2), "prompt_state": True, "action_length": 6}
    loaded = loading.load_checkpoint(str(folder), tokenizer=WORDS, **given)["base"].policy
    assert "pi05_libero" in capsys.readouterr().err
    assert (loaded.model.config.chunk, loaded.model.config.max_tokens) == (20, 200)
    inputs = loaded.processor.inputs
    assert (inputs.delta, inputs.prompt_state) == ((True, False, True), True)
    assert len(loaded.processor.action_slots) == 6


def test_everything_can_be_given_without_a_training_config(tmp_path, echo, capsys):
    folder = checkpoint(tmp_path / "mine", {"libero": LIBERO})
    given: Any = {"size": "base", "chunk": 50, "relative": range(6)}
    loaded = loading.load_checkpoint(str(folder), tokenizer=WORDS, **given)["base"].policy
    name = "pi0_libero"
    named = loading.load_checkpoint(str(folder), tokenizer=WORDS, openpi_config=name)["base"].policy
    assert dataclasses.replace(named.model.config.inputs, delta=(True,) * 6) == (
        loaded.model.config.inputs
    )
    assert loaded.processor.action_slots == named.processor.action_slots == tuple(range(7))
    assert not capsys.readouterr().err


def test_padded_statistics_and_several_datasets(tmp_path, echo):
    """Older checkpoints have 32 numbers for every robot; base checkpoints have several robots."""
    padded = [openpi_requests.statistics(start, 32) for start in (0, 2)]
    other = [openpi_requests.statistics(start, 14) for start in (4, 6)]
    folder = checkpoint(tmp_path / "base", {"droid": padded, "trossen": other})
    for name, mean in (("pi05_droid", padded[1]), ("pi05_aloha", other[1])):
        served = loading.load_checkpoint(str(folder), tokenizer=WORDS, openpi_config=name)["base"]
        processor = served.policy.processor
        length = openpi_configs.find(name).robot.action_length
        assert processor.action_slots == tuple(range(length))
        learned = np.asarray(processor.statistics.action["mean"])
        np.testing.assert_allclose(learned[:length], mean["mean"][:length], rtol=1e-6)
    with pytest.raises(ValueError, match=r"statistics of \['droid', 'trossen'\]"):
        loading.load_checkpoint(str(folder), tokenizer=WORDS, openpi_config="pi0_libero")


def test_a_default_prompt_and_the_pose_to_start_from_are_served(tmp_path, echo):
    stats = [openpi_requests.statistics(start, 14) for start in (0, 2)]
    folder = checkpoint(tmp_path / "pi0_aloha_towel", {"trossen": stats})
    loaded = loading.load_checkpoint(str(folder), tokenizer=WORDS)["base"]
    served = ServedPolicies({"base": CompiledPolicy(loaded, max_batch=1)})
    said = server.describe(served)
    assert (said["reset_pose"], said["action_horizon"]) == ([0, -1.5, 1.5, 0, 0, 0], 50)
    assert said["cameras"] == ["cam_high", "cam_left_wrist", "cam_right_wrist"]
    request = requests.parse(openpi_requests.request("aloha", 0, prompt=False), served.spec)
    given = dataclasses.replace(request, prompt="fold the towel")
    rows = [prepared(served, each) for each in (request, given)]
    np.testing.assert_array_equal(rows[0]["ids"], rows[1]["ids"])


def test_a_conversion_to_pytorch_says_its_sizes_only(tmp_path, echo):
    """openpi's conversion writes sizes, without a policy type (case of a config.json)."""
    folder = conversion(tmp_path / "torch", chunk=10, tensor="action_in_proj.bias")
    with pytest.raises(ValueError, match=r"else --relative$"):
        loading.load_checkpoint(str(folder), tokenizer=WORDS)
    loaded = loading.load_checkpoint(str(folder), tokenizer=WORDS, relative=())["base"].policy
    assert loaded.model.config.chunk == 10
    save_file({"time_mlp_in.weight": np.zeros(1)}, folder / "model.safetensors")
    with pytest.raises(ValueError, match=r"else --relative, --prompt-state$"):
        loading.load_checkpoint(str(folder), tokenizer=WORDS)


def test_a_recorded_chunk_wins_over_the_folders_name(tmp_path, echo):
    """pi05_libero has 10; this one was trained with 30."""
    folder = conversion(tmp_path / "pi05_libero", chunk=30, tensor="time_mlp_in.weight")
    loaded = loading.load_checkpoint(str(folder), tokenizer=WORDS)["base"].policy
    assert loaded.model.config.chunk == 30
    assert checkpoints.find(folder).config.chunk == 30


def test_a_tokenizer_is_not_assumed(tmp_path, echo, monkeypatch):
    """openpi's checkpoints have openpi's; for others of a published vocabulary it must be given."""
    asked = []
    monkeypatch.setattr(loading, "load_tokenizer", lambda where: asked.append(where) or 1 / 0)
    folder = checkpoint(tmp_path / "pi0_libero", {"libero": LIBERO})
    with pytest.raises(ZeroDivisionError):
        loading.load_checkpoint(str(folder))
    assert asked == ["gs://big_vision/paligemma_tokenizer.model"]
    (folder / "config.json").write_text(json.dumps({"type": "pi0"}))
    (folder / "params" / "_METADATA").unlink()
    with pytest.raises(ValueError, match="pass --tokenizer"):
        loading.load_checkpoint(str(folder))
    for option in ({"openpi_config": "pi0_libero"}, {"size": "base"}):
        with pytest.raises(ValueError, match="pi0_libero is none"):
            loading.load_checkpoint(str(folder), **option)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A tiny checkpoint of openpi, and its config."""
    cameras = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")
    sizes = {"cameras": cameras, "action_dim": 32, "max_tokens": 12, "inputs": OPENPI}
    config = dataclasses.replace(Pi0Config.dummy(), **sizes)
    folder = tmp_path_factory.mktemp("checkpoints") / "pi0_libero"
    published.save(folder, random_backbone(config), "openpi")
    (folder / "assets" / "libero").mkdir(parents=True)
    text = json.dumps({"norm_stats": dict(zip(("state", "actions"), LIBERO, strict=True))})
    (folder / "assets" / "libero" / "norm_stats.json").write_text(text)
    return folder, config


def test_a_network_of_relative_actions_is_served(weights, monkeypatch):
    """Its actions are those of the same network with absolute ones, plus the state."""
    folder, config = weights
    monkeypatch.setattr(Pi0Config, "base", lambda: dataclasses.replace(config))
    served = {
        name: ServedPolicies({"base": CompiledPolicy(loaded["base"], num_steps=1, max_batch=1)})
        for name, loaded in {
            "named": loading.load_checkpoint(str(folder), chunk=4),
            "absolute": loading.load_checkpoint(str(folder), relative=(), chunk=4),
        }.items()
    }
    message = openpi_requests.request("libero", 3) | {"prompt": "press the button"}
    answers = {}
    for name, policy in served.items():
        answers[name] = actions(policy, requests.parse(message, policy.spec))[0]
    assert answers["named"].shape == (4, 7)
    added = np.broadcast_to(np.append(message["observation/state"][:6], 0), (4, 7))
    np.testing.assert_allclose(answers["named"] - answers["absolute"], added, atol=1e-6)


def test_models_load_follows_the_name(weights, monkeypatch, capsys):
    folder, config = weights
    monkeypatch.setattr(Pi0Config, "base", lambda: dataclasses.replace(config, chunk=7))
    model = models.load(folder)
    assert (model.config.chunk, model.config.inputs.delta[:6]) == (50, (True,) * 6)
    assert "pi0_libero" in capsys.readouterr().err
    assert models.load(folder, config).config == config


def test_the_command_passes_the_options_on(weights, monkeypatch):
    given = {}

    def load(where, **options):
        given.update(options, where=where)
        raise ValueError("enough")

    monkeypatch.setattr(loading, "load_checkpoint", load)
    folder, words = str(weights[0]), "--chunk 10 --relative 0-2,4 --prompt-state no --joints 6"
    assert command.main([folder, *words.split(), "--port", "0"]) == 2
    expected = {"chunk": 10, "relative": (0, 1, 2, 4), "prompt_state": False, "joints": 6}
    assert {name: given[name] for name in expected} == expected
    assert not {"openpi_config", "size", "action_length"} & set(given)
    assert command.main([folder, "--relative", "none", "--port", "0"]) == 2
    assert given["relative"] == ()


def test_bad_numbers_are_refused(capsys):
    for words in (["--relative", "0-"], ["--relative", "5-0"], ["--chunk", "0"]):
        with pytest.raises(SystemExit):
            command.main(["x", *words])
        assert re.search(rf"{words[0]}.*{words[1]}", capsys.readouterr().err)
