"""Learning from episodes of which half took a wrong action and failed."""

import dataclasses
import io
import re
import time

import jax
import numpy as np
import pytest
from rich.console import Console

from envs.datasets import rlds
from envs.datasets.episodes import Episodes
from lorasp_jax.adapters import adaptation
from lorasp_jax.config import DataConfig
from lorasp_jax.config.recap import RecapConfig
from lorasp_jax.data import cache, lerobot_export
from lorasp_jax.data.batches import draw, gather
from lorasp_jax.data.opening import open_source
from lorasp_jax.data.stream import Stream
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig
from lorasp_jax.peft import LoRA
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.tokenizer import Offline
from lorasp_jax.training import advantage, export, finished_run, offline, setup
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.loop import train
from lorasp_jax.training.overrides import parse
from lorasp_jax.training.run_folder import ADVANTAGES, to_json, write_json
from tests import ROOT
from tests.data.test_labels import labelled
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, Terminate, leaves, random_episodes

EPISODES, STEPS = 40, 6
BACKBONES = {"pi0": Pi0Config, "smolvla": SmolVLAConfig}


def fork():
    """From the same place, every other episode goes left and fails, or right and succeeds."""
    right = np.arange(EPISODES) % 2 == 0
    goal = np.where(right, 1.0, -1.0)[:, None, None] * np.ones((1, STEPS, 7))
    state = goal * np.arange(STEPS)[:, None] / STEPS
    noise = np.random.default_rng(0).normal(size=(2, EPISODES, STEPS, 7)) * 0.05
    return Episodes(
        image={"side": np.zeros((EPISODES, STEPS, 32, 32, 3), np.uint8)},
        state=(state + noise[0]).astype(np.float32),
        action=(goal + noise[1]).astype(np.float32),
        length=np.full(EPISODES, STEPS, np.int32),
        instruction=np.zeros(EPISODES, np.int32),
        instructions=("press the button",),
        task="press",
        robot="piper",
        control_dt=0.1,
        physics_dt=0.0,
        attempted=EPISODES,
        success=right.astype(np.int32),
    )


def prepare(folder, learn, backbone="pi0", **more):
    """Prepare a run on `folder`/data with the dummy backbone."""
    source = DataConfig(str(folder / "data"), validation=("0",))
    options = {"data": source, "learn": learn, "peft": LoRA(rank=8), "targets": (".*",)}
    optim = {"steps": 300, "batch_size": 16, "learning_rate": 1e-2, "warmup_steps": 10}
    options["optim"] = dataclasses.replace(CONFIG.optim, **optim, state_noise=0.0)
    options["evaluation"] = dataclasses.replace(CONFIG.evaluation, execute_steps=1)
    config = dataclasses.replace(CONFIG, **{**options, "log_every": 300, **more})
    model = random_backbone(BACKBONES[backbone].dummy())
    remat = "none", preflight.Memory(*6 * [0.0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preflight, "available_bytes", lambda: 2**40)
        patch.setattr(preflight, "choose_remat", lambda *_: remat)
        patch.setattr(setup, "base_model", lambda *_, **__: (model, ""))
        run_folder = folder / f"{learn}-{backbone}"
        run_folder.mkdir(exist_ok=True)
        console = Console(file=io.StringIO(), width=200)
        run = setup.prepare(config, run_folder, console, time.perf_counter())
    run.devices = jax.devices()[:1]
    return run


sample = jax.jit(Policy.sample)


def right(run, row=0):
    """Return how often the policy goes right at the fork, told what `row` of its prompts says."""
    observation = {"image": {"side": np.zeros((64, 32, 32, 3), np.uint8)}}
    observation["state"] = np.zeros((64, 7), np.float32)
    policy = run.policy.with_sampler()
    actions = sample(policy, jax.random.key(0), observation, np.full(64, row, np.int32))
    return float((np.asarray(actions)[:, 0, 0] > 0).mean())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fork")
    rlds.write(fork(), folder / "data")
    return folder


def trained(folder, learn, backbone="pi0", **more):
    run = prepare(folder, learn, backbone, **more)
    train(run)
    return run


def test_asked_for_good_actions_recap_does_them(folder):
    """Asked for bad ones, those; not asked, either."""
    run = trained(folder, "recap")
    assert right(run) > 0.9
    assert right(run, 1) < 0.2
    assert 0.2 < right(run, 2) < 0.8
    table = run.policy.processor.prompts
    tokens = table.with_instructions(Offline(), ["press the button"]).start  # as a server does
    np.testing.assert_array_equal(tokens.ids[0], table.start.ids[0])


@pytest.mark.slow
@pytest.mark.parametrize("backbone", BACKBONES)
def test_what_failed_is_not_learned(folder, tmp_path, backbone, monkeypatch):
    """Imitation is torn between both, and so is recap if what is good is drawn by lot."""
    (tmp_path / "data").symlink_to(folder / "data")
    found = {x: right(trained(tmp_path, x, backbone)) for x in ("imitation", "filtered", "recap")}
    assert 0.05 < found["imitation"] < 0.95
    assert found["filtered"] > 0.95
    assert found["recap"] > 0.9
    computed = advantage.advantages

    def by_lot(*arguments):
        true = computed(*arguments)
        return true._replace(good=np.random.default_rng(0).permutation(true.good))

    monkeypatch.setattr(advantage, "advantages", by_lot)
    (tmp_path / "lot").mkdir()
    (tmp_path / "lot" / "data").symlink_to(folder / "data")
    shuffled = right(trained(tmp_path / "lot", "recap", backbone))
    assert 0.05 < shuffled < 0.95
    assert shuffled < found["recap"]


def test_filtered_uses_successes_and_corrections_alone(tmp_path):
    """Also in statistics; a chunk ends where the correction does."""
    episodes = dataclasses.replace(labelled(), instructions=("press the button", "push it"))
    rlds.write(episodes, tmp_path / "data")  # of 5 steps, and of 9, of which a person does 3
    run = prepare(tmp_path, "filtered")
    assert run.steps.starts.tolist() == [0, 1, 2, 3, 4, 11, 12, 13]
    raw = gather(run.steps, np.array([0, 11, 13]), 4)
    assert raw.inside.sum(axis=1).tolist() == [4, 3, 1]
    used = np.concatenate([episodes.action[0, :5], episodes.action[1, 6:9]])
    processor = run.policy.processor
    mean = processor.statistics.action["mean"][np.array(processor.action_slots)]
    np.testing.assert_allclose(mean, used.mean(0), atol=1e-6)
    printed = run.console.file.getvalue()
    assert "1 successes, 1 failures, 1 episodes without an outcome, 3 corrected steps" in printed


def test_what_does_not_count_is_not_held_out(folder, tmp_path):
    (tmp_path / "data").symlink_to(folder / "data")
    data = DataConfig(str(tmp_path / "data"))  # of 20 successes, a tenth
    run = prepare(tmp_path, "filtered", data=data)
    assert len(run.held_out) == 2
    assert all(number % 2 == 0 for number in run.held_out)
    assert not {*run.held_out} & {*run.recordings.episodes[run.steps.starts].tolist()}


def test_imitation_of_failures_is_said(folder):
    run = prepare(folder, "imitation")
    assert run.steps.num_starts == EPISODES * STEPS
    assert "failures are imitated, too" in run.console.file.getvalue()


@pytest.mark.parametrize(
    ("outcomes", "held_out", "sentence"),
    [
        ([1, 0, 1], 1, "all held-out episodes failed, so the adapters"),
        ([0, 0, 1], 2, "all episodes to learn from failed: "),
        ([1, 0, 1], 0, ""),
        ([-1, 0, -1], 0, ""),
    ],
)
def test_imitation_says_if_one_side_has_failures_alone(outcomes, held_out, sentence, tmp_path):
    """But holds out what it was told to."""
    rlds.write(labelled(0, outcomes), tmp_path / "data")
    data = DataConfig(str(tmp_path / "data"), validation=(f"episode_{held_out}",))
    run = prepare(tmp_path, "imitation", data=data, targets=("action_out",))
    assert run.held_out == [held_out]
    said = re.findall("warning: (all .*)", run.console.file.getvalue())
    assert len(said) == bool(sentence)
    assert "".join(said).startswith(sentence)


def test_it_resumes_to_the_bit(folder, tmp_path):
    kept, learn = [], "recap"
    for name in ("whole", "halved"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "data").symlink_to(folder / "data")
        options = {"optim": dataclasses.replace(CONFIG.optim, steps=4, batch_size=8)}
        options |= {"log_every": 2, "targets": ("action_out",)}
        run = prepare(tmp_path / name, learn, **options)
        write_json(run.folder / "config.json", to_json(run.config))
        if name == "halved":
            with pytest.raises(KeyboardInterrupt):
                train(run, [Terminate()])
            run = prepare(tmp_path / name, learn, **options)
        train(run, resume=name == "halved")
        kept.append(leaves(adaptation.split(run.policy.model)[1]))
    for name, value in kept[0].items():
        np.testing.assert_array_equal(kept[1][name], value)


def test_values_are_read_again_and_a_damaged_file_is_refused(folder, monkeypatch):
    run = prepare(folder, "recap")
    monkeypatch.setattr(advantage, "features", lambda *_: pytest.fail("computed again"))
    again = prepare(folder, "recap")
    np.testing.assert_array_equal(again.steps.instruction, run.steps.instruction)
    path = run.folder / ADVANTAGES
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=ADVANTAGES):
        prepare(folder, "recap")
    path.unlink()


@pytest.mark.parametrize(
    ("learn", "outcomes", "sentence"),
    [
        ("filtered", [-1, -1, -1], "does not say which episodes succeeded, as --learn filtered"),
        ("recap", [-1, -1, -1], "does not say which episodes succeeded, as --learn recap"),
        ("filtered", [0, 0, -1], "no episode of press succeeded, so --learn filtered cannot"),
        ("recap", [0, 0, 0], "no episode of press succeeded, so --learn recap cannot"),
        ("recap", [1, 1, 1], "no recorded episode failed, so --learn recap has nothing"),
    ],
)
def test_recordings_that_cannot_be_learned_from(learn, outcomes, sentence, tmp_path):
    episodes = dataclasses.replace(labelled(0, outcomes), corrected=None)
    rlds.write(episodes, tmp_path / "data")
    with pytest.raises(ValueError, match=sentence):
        prepare(tmp_path, learn)


def test_settings_that_make_no_sense(tmp_path):
    for learn in ("filtered", "recap"):
        with pytest.raises(ValueError, match=f"learn {learn} needs recordings"):
            dataclasses.replace(CONFIG, learn=learn)
    data = DataConfig(str(tmp_path))
    with pytest.raises(ValueError, match="recap has settings, which learn filtered ignores"):
        dataclasses.replace(CONFIG, learn="filtered", data=data, recap=RecapConfig(share=0.4))
    wrong = {"steps": 0, "share": 1.0, "dropout": 1.0}
    for name, value in wrong.items():
        with pytest.raises(ValueError, match=f"recap.{name} must"):
            RecapConfig(**{name: value})
    long = dataclasses.replace(labelled(), instructions=("press the button", 10 * "up "))
    rlds.write(long, tmp_path / "data")
    with pytest.raises(ValueError, match="max-tokens 11"):
        prepare(tmp_path, "recap")


def test_on_the_command_line_and_in_the_file_of_a_run():
    command = ["--config", f"{ROOT}/configs/multitask.py", "--scale", "smoke"]
    options = ["--data.source", "a", "--learn", "recap", "--recap.share", "0.4"]
    config = parse([*command, *options]).config
    assert (config.learn, config.recap.share) == ("recap", 0.4)
    written = to_json(config)
    assert written["recap"] == {"steps": 10, "share": 0.4, "dropout": 0.3}
    assert finished_run._from_json(written, config.tasks) == config
    assert not {"learn", "recap"} & to_json(parse([*command]).config).keys()


def test_values_know_the_outcome_and_advantages_the_fork(folder):
    run = prepare(folder, "recap")
    with np.load(run.folder / ADVANTAGES) as found:
        good = found["good"].reshape(EPISODES, STEPS)
        assert found["correlation"] > 0.7
    assert good[::2, 0].all()
    assert not good[1::2, 0].any()
    assert good.mean() == pytest.approx(0.3, abs=0.01)
    described = export._metadata(run)["policy"]
    assert described["endings"] == ["+", "-", ""]
    loaded = export._processor(described, run.policy.model.config, "")  # refuses other tokens
    assert loaded.prompts.instructions == ("press the button",)
    told = np.bincount(run.steps.instruction, minlength=3) / good.size
    assert told[2] == pytest.approx(0.3, abs=0.07)


def test_advantages_of_known_values(tmp_path, monkeypatch):
    """A success of 5 steps, a failure of 9 whose end is a person's, and one of 7 not judged."""
    rlds.write(labelled(), tmp_path / "data")
    config = dataclasses.replace(CONFIG, learn="recap", data=DataConfig(str(tmp_path / "data")))
    config = dataclasses.replace(config, recap=RecapConfig(steps=3, share=0.25))
    cache.write([open_source(tmp_path / "data")], tmp_path / "cache", lambda *_: None)
    recordings = cache.Cache(tmp_path / "cache")
    chosen = offline.choose(recordings, config)
    value, seen = np.linspace(-0.9, -0.1, 21), []
    monkeypatch.setattr(advantage, "_values", lambda *given: seen.append(given) or value)
    found = advantage.advantages(recordings, chosen, config, np.zeros((21, 1)))
    returns, scale = np.array([*range(-4, 1), *(t - 9 for t in range(-8, 1))]) / 18, 18
    np.testing.assert_allclose(seen[0][1][:14], returns)
    assert seen[0][3].tolist() == 14 * [True] + 7 * [False]
    within = value[3:5] - value[:2] - 3 / scale  # three steps later, the episode goes on
    np.testing.assert_allclose(found.advantage[:2], within, atol=1e-6)
    np.testing.assert_allclose(found.advantage[2:5], returns[2:5] - value[2:5], atol=1e-6)
    np.testing.assert_allclose(found.advantage[11:14], returns[11:] - value[11:14], atol=1e-6)
    policy = found.good[:11]  # what a person did is always good, and not compared
    assert policy.sum() == 3
    assert set(np.flatnonzero(policy)) == set(np.argsort(found.advantage[:11])[-3:])
    assert found.good[11:14].all()
    assert not found.good[14:].any()


def joined(folder, learn, data=None, **sources):
    """Prepare a run on datasets by name."""
    for name, episodes in sources.items():
        if episodes.success is None:
            lerobot_export.to_lerobot(Unlabelled(episodes), folder / name, lambda *_: None)
        else:
            rlds.write(episodes, folder / name)
    paths = tuple(str(folder / name) for name in sources)
    return prepare(folder, learn, data=DataConfig(paths, **{"validation": ("0",), **(data or {})}))


UNKNOWN = np.full(3, -1, np.int32)


@pytest.mark.parametrize("success", [None, UNKNOWN])
def test_of_corrected_recordings_without_outcomes_the_corrections_count(success, tmp_path):
    """Alone, and joined with others."""
    hil = dataclasses.replace(labelled(1), success=success)
    run = joined(tmp_path, "filtered", tries=labelled(), hil=hil)
    assert run.steps.starts.tolist() == [0, 1, 2, 3, 4, 11, 12, 13, 32, 33, 34]
    (tmp_path / "alone").mkdir()
    alone = joined(tmp_path / "alone", "filtered", hil=hil)
    assert alone.steps.starts.tolist() == [11, 12, 13]
    assert "0 successes, 0 failures, 3 episodes" in alone.console.file.getvalue()


def test_what_nobody_judged_is_no_demonstration(tmp_path):
    unjudged = dataclasses.replace(labelled(1), success=UNKNOWN, corrected=None)
    run = joined(tmp_path, "filtered", tries=labelled(), unjudged=unjudged)
    assert run.steps.starts.max() == 13
    assert "demonstrations" not in run.console.file.getvalue()


def test_demonstrations_of_which_one_was_not_judged(tmp_path):
    shown = dataclasses.replace(labelled(1, [1, 1, -1]), corrected=None)
    run = joined(tmp_path, "filtered", tries=labelled(), shown=shown)
    assert run.chosen.demonstrated.tolist() == [*3 * [False], True, True, False]
    assert run.steps.starts.tolist() == [0, 1, 2, 3, 4, 11, 12, 13, *range(21, 35)]
    assert "demonstrations: shown" in run.console.file.getvalue()


@pytest.mark.parametrize("stream", [False, True])
def test_a_policy_that_never_succeeded_is_joined_with_demonstrations(stream, tmp_path):
    """Nothing of it is drawn, and where each dataset has its statistics, it has those of all."""
    tries = dataclasses.replace(labelled(0, [0, 0, -1]), corrected=None)
    shown = dataclasses.replace(random_episodes("press", 1), physics_dt=0.0)
    data = {"weights": (1.0, 3.0), "statistics": "each"}
    run = joined(tmp_path, "filtered", data, tries=tries, shown=shown)
    assert run.steps.mixture.shares.tolist() == [0, 1]
    drawn = (
        next(Stream(run.steps, batch_size=64, chunk=1, seed=0))
        if stream
        else draw(jax.random.key(0), jax.device_put(run.steps), batch_size=64, chunk=1)
    )
    assert set(np.asarray(drawn.dataset).tolist()) == {1}


def test_recap_learns_from_failures_with_corrections(tmp_path):
    rlds.write(labelled(0, [0, 0, -1]), tmp_path / "data")
    cache.write([open_source(tmp_path / "data")], tmp_path / "cache", lambda *_: None)
    recordings = cache.Cache(tmp_path / "cache")
    data = DataConfig(str(tmp_path / "data"))
    config = dataclasses.replace(CONFIG, learn="recap", data=data)
    chosen = offline.choose(recordings, config)
    offline.check(chosen, recordings, (), "recap")
    assert chosen.left_out == (2,)


@pytest.mark.parametrize(
    ("validation", "sentence"),
    [
        (("episode_1",), "names episode_1, which did not succeed, so --learn filtered cannot"),
        (("1",), "must leave some of the 0 episodes that succeeded"),
    ],
)
def test_failures_are_not_held_out(validation, sentence, tmp_path):
    outcomes = [1, 0, -1] if validation == ("episode_1",) else [0, 0, -1]
    with pytest.raises(ValueError, match=sentence):
        joined(tmp_path, "filtered", {"validation": validation}, tries=labelled(0, outcomes))


def test_equal_values_have_a_share_of_good_ones_and_no_correlation(folder, monkeypatch):
    run = prepare(folder, "imitation")
    monkeypatch.setattr(advantage, "_values", lambda x, *_: np.zeros(len(x)))
    found = advantage.advantages(run.recordings, run.chosen, run.config, np.zeros((240, 1)))
    assert found.good.mean() == pytest.approx(0.3)
    assert found.correlation == 0


def test_one_known_outcome_is_what_all_steps_are_worth():
    returns, episode = np.linspace(-1, 0, 6), np.repeat([0, 1, 2], 2)
    observed = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    value = advantage._values(observed, returns, episode, episode == 1)
    np.testing.assert_allclose(value[2:4], returns[2:4].mean())


def test_demonstrations_are_good(tmp_path):
    """A dataset without outcomes or failures, joined with a policy's episodes."""
    rlds.write(labelled(), tmp_path / "tries")
    shown = dataclasses.replace(random_episodes("press", 1), physics_dt=0.0)
    rlds.write(shown, tmp_path / "shown")
    lerobot_export.to_lerobot(Unlabelled(shown), tmp_path / "lerobot", lambda *_: None)
    names = ("tries", "shown", "lerobot")
    data = DataConfig(tuple(str(tmp_path / x) for x in names), validation=("0",))
    run = prepare(tmp_path, "recap", data=data)
    with np.load(run.folder / ADVANTAGES) as found:
        assert found["good"][21:].all()
    assert "demonstrations: shown, lerobot" in run.console.file.getvalue()


class Unlabelled:
    """Episodes as a dataset that says nothing of their outcome."""

    kind, cameras, left_out, control_dt, num_steps = "test", ("side", "wrist"), {}, 0.1, 21

    def __init__(self, episodes):
        self.episodes = episodes

    def __len__(self):
        return self.episodes.num_episodes

    def episode(self, number, cameras=None):
        return self.episodes.select([number])
