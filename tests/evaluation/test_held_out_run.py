"""A finished run, measured on the episodes that its training held out, as its files say."""

import dataclasses
import re
import shutil

import numpy as np
import pytest

from envs.datasets import rlds
from lorasp_jax import models
from lorasp_jax.evaluation import measure_held_out
from lorasp_jax.evaluation.__main__ import main
from lorasp_jax.evaluation.held_out import measure, windows
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.training import export
from lorasp_jax.training.run_folder import CACHE, to_json, write_json
from tests.models.random_models import random_backbone
from tests.runs import RESULTS
from tests.training.test_dataset import prepare
from tests.training.test_datasets import (  # noqa: F401  (a fixture)
    NAMES,
    config,
    recorded,
    sources,
)


def finished(root, sources, **data):  # noqa: F811
    """Return a run on datasets with what it leaves when it has finished."""
    models.save(root / "weights", random_backbone(Pi0Config.dummy()))
    settings = config(sources, **data)
    model = dataclasses.replace(settings.model, checkpoint=str(root / "weights"))
    (root / "run").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        settings = dataclasses.replace(settings, model=model)
        run = prepare(root / "run", patch, "", config=settings)
    run.base_hash = models.weights_hash(root / "weights")
    write_json(run.folder / "config.json", to_json(run.config))
    write_json(run.folder / "results.json", RESULTS | {"tasks": {}})
    export.write(run)
    return run


@pytest.fixture(scope="module")
def alone(tmp_path_factory, sources):  # noqa: F811
    """A run on a user's dataset, of which it holds the second episode out."""
    root = tmp_path_factory.mktemp("alone")
    shutil.copytree(sources[0], root / "mine")
    data = {"statistics": "shared", "validation": ("episode_1",)}
    return finished(root, (str(root / "mine"),), **data)


@pytest.fixture(scope="module")
def both(tmp_path_factory, sources):  # noqa: F811
    """A run on two datasets, of each of which it holds an episode out."""
    return finished(tmp_path_factory.mktemp("both"), sources)


def error(found):
    return found.policy.mean, found.hold.mean, found.repeat.mean


def test_exactly_what_training_held_out(alone, capsys):
    found = measure_held_out(alone.folder)
    assert [*found] == ["mine"]
    policy = export.load_policy(alone.folder)
    expected = measure(policy, windows(alone.recordings, [1], policy), num_steps=5)
    assert len(found["mine"].actions) == alone.recordings.episode(1, ()).num_steps
    np.testing.assert_allclose(found["mine"].actions, expected.actions, rtol=1e-5, atol=1e-5)
    assert main([str(alone.folder), "--held-out"]) == 0
    printed = capsys.readouterr().out
    assert (
        "action error {:.3f}, holding still {:.3f}, repeating".format(*error(expected)) in printed
    )
    assert "mean of" not in printed
    assert (alone.folder / "evaluate_held_out" / "held_out_press.png").is_file()


def test_each_dataset_by_its_own_policy_and_their_mean(both, tmp_path, capsys):
    found = measure_held_out(both.folder)
    assert [*found] == [*NAMES]
    for index, name in enumerate(NAMES):
        (number,) = (n for n in both.held_out if n // 3 == index)
        own = export.load_policy(both.folder, dataset=name)
        expected = measure(own, windows(both.recordings, [number], own), num_steps=5)
        np.testing.assert_allclose(error(found[name]), error(expected), rtol=1e-5)
    words = [str(both.folder), "--held-out", "--out", str(tmp_path / "out")]
    assert main(words) == 0
    printed = capsys.readouterr().out
    figures = {name: error(x)[0] for name, x in found.items()}
    figures["mean of 2 datasets"] = sum(figures.values()) / 2
    for name, value in figures.items():
        assert re.search(rf"^{name}: action error {value:.3f},", printed, re.MULTILINE)
    assert {path.parent.name for path in tmp_path.glob("out/*/*.png")} == {*NAMES}
    only = measure_held_out(both.folder, dataset="far", num_steps=2)
    assert [*only] == ["far"]
    assert np.abs(only["far"].actions - found["far"].actions).max() > 1e-4
    with pytest.raises(ValueError, match="held out episodes of near, far, none of 'other'"):
        measure_held_out(both.folder, dataset="other")


def test_recordings_that_have_moved_or_changed(alone, tmp_path):
    """The run's cache is enough; without it, they are read again."""
    root = shutil.copytree(alone.folder.parent, tmp_path / "copy")
    source, run = alone.folder.parent / "mine", root / "run"
    shutil.move(source, tmp_path / "moved")
    assert [*measure_held_out(run, num_steps=1)] == ["mine"]
    shutil.rmtree(run / CACHE)
    with pytest.raises(ValueError, match=f"recordings of {run} cannot be read: {source} does not"):
        measure_held_out(run)
    rlds.write(recorded(7, 1.0), source)
    with pytest.raises(ValueError, match=f"dataset differs from the one {run} was started with"):
        measure_held_out(run)
    shutil.rmtree(source)
    shutil.move(tmp_path / "moved", source)
    assert [*measure_held_out(run, num_steps=1)] == ["mine"]


def test_refusals(sources, tmp_path, capsys):  # noqa: F811
    run = finished(tmp_path, sources[:1], validation=("0",), statistics="shared").folder
    assert main([str(run), "--held-out"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert f"{run} has no episodes that training held out: name recordings with --data" in said
    assert main([str(tmp_path / "none"), "--held-out"]) == 2
    assert "there is no folder" in capsys.readouterr().err
    for words in (["--episodes", "1"], ["--every", "2"], ["--seed", "1"], ["--data", "x"]):
        with pytest.raises(SystemExit):
            main([str(run), "--held-out", *words])
        assert f"{words[0]}: not allowed with argument --held-out" in capsys.readouterr().err
