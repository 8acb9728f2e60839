"""The study of few demonstrations: its cells, and what its page makes of results."""

import jax
import numpy as np
import pytest
from scipy import stats

from lorasp_jax.config import Config
from lorasp_jax.extras.study import statistics
from lorasp_jax.extras.study.held_out import AllTasks
from lorasp_jax.peft import FullFineTuning
from studies.few import judge, page, study
from tests.runs import random_episodes

STUDY = study.get_study("accelerator")


@pytest.fixture(scope="module")
def results():
    """Results in which success rises with N, the action error ranks policies, and the loss not."""
    rng, found = np.random.default_rng(0), {}
    for cell in STUDY.cells:
        config = cell.config if isinstance(cell.config, Config) else cell.config(found)
        rate = min(0.9, 0.1 + 0.13 * np.log(config.data.episodes))
        rate -= 0.5 * (config.optim.learning_rate == 1e-3) + 0.03 * (config.seed % 3)
        outcomes = {
            f"{scene}/{task}": "1" * round(40 * share * rate)
            + "0" * (40 - round(40 * share * rate))
            for scene, share in (("recorded", 1.0), ("shifted", 0.5))
            for task in config.tasks
        }
        measures = {"action_error": 1 - rate, "loss": rng.normal(), "config": config}
        found[cell.name] = {"outcomes": outcomes, **measures}
    return found


def test_policies_differ_in_what_their_names_say(results):
    for cell in STUDY.cells:
        config = results[cell.name]["config"]
        assert cell.pool == 512
        if "/pilot/" in cell.name:
            continue
        backbone, method, kind, count, seed = cell.name.split("/")
        assert config.model.backbone == backbone
        assert f"n{config.data.episodes}" == count
        assert f"s{config.seed}" == seed
        if kind in study.PARTS:
            assert config.data.augment == study.PARTS[kind]
            continue
        augment, _, steps = kind.partition("_")
        assert config.data.augment.preset == augment
        assert config.optim.steps == int(steps or 2000)
        assert isinstance(config.peft, FullFineTuning) == (method == "full")
        assert bool(config.adapt) == (method == "vlm_lora")
        assert config.optim.learning_rate == 3e-4  # the better one of the pilots


def test_page(results, tmp_path, monkeypatch):
    monkeypatch.setattr(statistics, "DRAWS", 100)
    monkeypatch.setattr(page, "DRAWS", 100)
    monkeypatch.setattr(statistics, "_counts", statistics._counts.__wrapped__)
    made = page.blocks(STUDY, results, tmp_path)
    made = {name: table.replace("\u00a0", " ") for name, table in made.items()}
    assert (tmp_path / "success.svg").read_text().count("LoRA-SP, R = 64") >= 1
    line = next(x for x in made["pi0 recorded"].splitlines() if x.startswith("| LoRA, r = 16 | no"))
    rates = [float(cell.split()[0]) for cell in line.split("|")[3:-1]]
    expected = [100 * min(0.9, 0.1 + 0.13 * np.log(n)) - 3 for n in page.COUNTS]
    assert rates == pytest.approx(expected, abs=1.3)
    everything = made["smolvla error"].splitlines()[-1].split("|")[2:-1]
    assert made["augmentation"].count("\n") == 2 + len(page.PARTS)
    error, loss = (float(cell.split()[0].replace("−", "-")) for cell in everything[:2])
    assert error < -0.99 < -0.5 < loss


def test_correlation_is_spearmans():
    rng = np.random.default_rng(1)
    errors = rng.integers(0, 8, 30) / 8.0  # with ties
    rates = rng.normal(size=30) - errors
    value = page._correlation(errors.tolist(), rates.tolist()).replace("−", "-").split()[0]
    assert float(value) == pytest.approx(stats.spearmanr(errors, rates).statistic, abs=0.005)


def test_demonstrations_are_measured_as_a_dataset():
    groups = {task: random_episodes(task, seed) for seed, task in enumerate(("press", "pour"))}
    source = AllTasks(groups)
    assert len(source) == 6
    for number, (group, row) in enumerate((g, r) for g in groups.values() for r in range(3)):
        episode = source.episode(number)
        assert episode.task == group.task
        np.testing.assert_array_equal(episode.state[0], group.state[row])
    assert source.control_dt == 0.1


def test_a_cropped_camera_shows_the_middle_of_its_pictures():
    (whole, _), (cropped, _) = (
        judge._rollout("recorded", "press", "piper", 2, 40, 10, crop) for crop in (False, True)
    )
    state = whole.reset(jax.random.key(0))
    given, shown = whole.observe(state)["image"], cropped.observe(state)["image"]
    np.testing.assert_array_equal(shown["wrist"], given["wrist"])
    assert shown["side"].shape == given["side"].shape
    middle = np.asarray(given["side"], float)[:, 1:39, 1:39]
    np.testing.assert_allclose(shown["side"][:, 0, 0], middle[:, 0, 0], atol=1)  # its corners
    np.testing.assert_allclose(shown["side"][:, -1, -1], middle[:, -1, -1], atol=1)
    assert abs(shown["side"].mean() - middle.mean()) < 0.5


def test_the_page_of_results_that_lack_policies(results, tmp_path, monkeypatch):
    monkeypatch.setattr(statistics, "DRAWS", 20)
    monkeypatch.setattr(page, "DRAWS", 20)
    monkeypatch.setattr(statistics, "_counts", statistics._counts.__wrapped__)
    some = {name: x for name, x in results.items() if not name.startswith("smolvla/full/none/n50")}
    some = {name: x for name, x in some.items() if "pi0/lora_r64/none_8000/n10" not in name}
    some.pop("pi0/full/none/n10/s2")
    made = page.blocks(STUDY, some, tmp_path)
    assert not [name for name in made if name.startswith("smolvla")]
    assert "(2 of 3)" in made["pi0 recorded"]
    assert made["pi0 steps"].splitlines()[2].endswith("| – |")
    assert [*page.blocks(STUDY, {}, tmp_path)] == ["augmentation"]
