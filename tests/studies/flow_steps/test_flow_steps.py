"""The study of flow steps: its cells, what its page makes of results, and its task of two ways."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.tasks import two_baskets
from lorasp_jax.extras.study import statistics
from studies.flow_steps import judge, page, study

STUDY = study.get_study("accelerator")
N = 40


@pytest.fixture(scope="module")
def results():
    """Results of policies that lose success below three steps if there are two ways."""

    def outcome(steps, task):
        rate = 0.5 if task == page.TWO_WAYS and steps < 3 else 0.8
        return "1" * round(N * rate) + "0" * (N - round(N * rate))

    cases = [(steps, task) for steps in page.STEPS for task in page.TASKS]
    one = {
        "outcomes": {f"{steps}/{task}": outcome(steps, task) for steps, task in cases},
        "jerk": {f"{steps}/{task}": 100.0 / steps for steps, task in cases},
        "spread": {f"{steps}/{task}": 0.25 for steps, task in cases},
    }
    return {cell.name: one for cell in STUDY.cells if cell.name.split("/")[1] in page.POLICIES}


def test_policies_differ_in_what_their_names_say():
    for cell in STUDY.cells:
        backbone, policy, seed = cell.name.split("/")
        assert cell.config.model.backbone == backbone
        assert f"s{cell.config.seed}" == seed
        assert (cell.config.optim.rtc_max_delay > 0) == (policy == "rtc")
        assert (cell.config.optim.time_shape > 1.5) == (policy == "noisy")
        assert cell.config.tasks == page.TASKS


def test_page(results, tmp_path, monkeypatch):
    monkeypatch.setattr(statistics, "DRAWS", 100)
    monkeypatch.setattr(statistics, "_counts", statistics._counts.__wrapped__)
    made = page.blocks(STUDY, results, tmp_path)
    made = {name: table.replace("\u00a0", " ") for name, table in made.items()}
    assert (tmp_path / "success.svg").stat().st_size
    rows = [line.split(" | ") for line in made["pi0 success"].splitlines()[2:]]
    assert [cell.split()[0] for cell in rows[0][2:]] == 5 * ["80.0"]
    assert [cell.split()[0] for cell in rows[4][2:]] == ["50.0", "50.0", "80.0", "80.0", "80.0"]
    lost = made["smolvla tasks"].splitlines()[-1].split(" | ")
    assert [cell.split()[0] for cell in lost[1:5]] == ["−30.0", "−30.0", "+0.0", "+0.0"]
    assert made["pi0 jerk"].splitlines()[2].split(" | ")[2:4] == ["100", "50"]


def test_distilled_policies_have_rows_at_their_number_of_steps(results, tmp_path, monkeypatch):
    monkeypatch.setattr(statistics, "DRAWS", 20)
    monkeypatch.setattr(statistics, "_counts", statistics._counts.__wrapped__)
    cells = [f"pi0/{name}/s{seed}" for name in page.DISTILLED for seed in page.SEEDS]
    assert {*cells} <= {cell.name for cell in STUDY.cells}
    table = lambda names: page.blocks(STUDY, results | dict.fromkeys(names, one), tmp_path)  # noqa: E731
    one = results["pi0/lora_sp/s0"]
    assert "distilled" not in table(cells[:2])["pi0 jerk"]
    rows = [line.split(" | ") for line in table(cells)["pi0 jerk"].splitlines()]
    shown = [row[2:] for row in rows if "distilled" in row[0] and row[1] == "two baskets"]
    assert shown == [["100", *3 * ["–"], "– |"], ["–", "50", *2 * ["–"], "– |"]]
    assert "distilled" not in table(cells)["smolvla jerk"]


def test_demonstrations_take_both_ways_whatever_is_seen():
    keys = jax.random.split(jax.random.key(0), 2000)
    layouts = jax.vmap(two_baskets._place)(keys)
    ends = jax.vmap(two_baskets._waypoints)(layouts).position[:, -1]
    to_left = jnp.linalg.norm(ends[:, :2] - layouts["left_basket"][:, :2], axis=1) < 1e-6
    to_right = jnp.linalg.norm(ends[:, :2] - layouts["right_basket"][:, :2], axis=1) < 1e-6
    assert jnp.all(to_left ^ to_right)
    assert abs(to_left.mean() - 0.5) < 0.05
    seen = jnp.concatenate([layout[:, :2] for layout in layouts.values()], axis=1)
    correlations = np.corrcoef(np.c_[seen, to_left].T)[-1, :-1]
    assert np.abs(correlations).max() < 0.1


def test_spread_is_that_over_noise():
    class Policy:
        def sample(self, key, observation, instruction, *, num_steps):
            shape = (*observation["state"].shape[:1], 8, 2)
            return num_steps * jax.random.normal(key, shape)

    jax.tree_util.register_static(Policy)

    class Raw:
        image, state, instruction = {}, jnp.zeros((300, 3)), jnp.zeros(300, jnp.int32)

    jax.tree_util.register_pytree_node(Raw, lambda _: ((Raw.state,), None), lambda _, __: Raw)
    found = judge._spread(Policy(), Raw(), 2)
    assert found.shape == (300, judge._EXECUTED, 2)
    assert found.mean() == pytest.approx(2 * 0.95, abs=0.05)


def test_the_page_leaves_out_a_backbone_that_lacks_policies(results, tmp_path, monkeypatch):
    monkeypatch.setattr(statistics, "DRAWS", 20)
    monkeypatch.setattr(statistics, "_counts", statistics._counts.__wrapped__)
    some = {name: x for name, x in results.items() if name != "smolvla/rtc/s1"}
    assert {name.split()[0] for name in page.blocks(STUDY, some, tmp_path)} == {"pi0"}
    assert page.blocks(STUDY, {}, tmp_path) == {}
