"""The comparison on Meta-World: its cells, and what the judge is asked."""

import dataclasses
import itertools
import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from lorasp_jax import peft
from lorasp_jax.data import cache as caches
from lorasp_jax.data import open_source
from lorasp_jax.extras.judge import __main__ as judging
from lorasp_jax.extras.study import Derived, progress, statistics
from lorasp_jax.extras.study import results as files
from lorasp_jax.extras.study.progress import describe_config
from lorasp_jax.training.run_folder import CACHE, MetricsLog, changed_settings
from studies.metaworld import dataset, judge, page, sequences, study
from studies.metaworld.tasks import EXTREME, GROUPS, HELD_OUT, INSTRUCTIONS, SETS
from studies.where_it_pays import sequences as learning
from studies.where_it_pays.sequence_page import KINDS
from tests import ROOT
from tests.runs import CONFIG, make_run

STUDY = study.get_study("accelerator")
RESULTS = files.load(ROOT / "studies/metaworld/results.json")


def test_sets_split_the_fifty_tasks():
    assert len(SETS["mt50"]) == 50
    assert sorted(SETS["ml45"] + SETS["ml5"]) == sorted(SETS["mt50"])


def test_every_method_has_three_seeds_on_its_sets():
    names = [cell.name for cell in STUDY.cells]
    for backbone in page.BACKBONES:
        for stage, methods in {"mt50": 14, "ml5": 5, "first5": 3, "single-reach": 2}.items():
            ran = [name for name in names if name.startswith(f"{backbone}/{stage}/")]
            assert len({name.split("/")[2] for name in ran}) == methods
            assert len(ran) == 3 * methods
    assert RESULTS.keys() <= {*names}


def test_smaller_sets_are_nested_and_balanced():
    sizes = [len(SETS[stage]) for stage in page.SIZES]
    assert sizes == [5, 10, 25, 50]
    for small, large in itertools.pairwise(page.SIZES):
        assert {*SETS[small]} < {*SETS[large]}
    for stage, size in zip(page.SIZES, sizes, strict=True):
        for group in GROUPS.values():
            assert abs(len({*SETS[stage]} & {*group}) - size * len(group) / 50) <= 1


def test_tasks_that_join_last_are_those_that_pilots_nearly_always_or_never_solve():
    pilots = [f"/pilot/{method}/" for method in page.LABELS]
    ran = [result for name, result in RESULTS.items() if any(each in name for each in pilots)]
    for task in SETS["mt50"]:
        digits = "".join(result["outcomes"][task] for result in ran)
        assert len(digits) == 120
        assert (task in EXTREME) == (not 12 <= digits.count("1") <= 96)


def test_policies_for_any_number_of_tasks_train_as_long_for_each():
    alone = [f"single-{task}" for task in SETS["first5"]]
    for kind in (*page.SIZES, *alone):
        cell = STUDY[f"pi0/{kind}/lora_sp/s0"]
        config = cell.config(RESULTS)
        (source,) = config.data.source
        assert config.optim.steps == 120 * max(len(SETS[Path(source).name]), 5)
        assert config.optim.warmup_steps <= config.optim.steps / 20
        assert config.optim.steps % config.log_every == 0
    assert {cell.group for cell in STUDY.cells if cell.name.startswith("pi0/single-")} == {
        f"pi0/single/{method}" for method in page.SHARED
    }


def test_both_methods_choose_their_rate_alike_at_every_rank():
    for rank, pair in page.RANKS.items():
        rates = [
            [name.rpartition("/")[2] for name in study._pilots(f"pi0/mt50/{method}/s0")]
            for method in pair
        ]
        assert rates[0] == rates[1]
        assert [study.METHODS[method].rank for method in pair] == [rank, rank]


def test_what_has_run_stays_finished(tmp_path):
    statuses = progress.read(dataclasses.replace(STUDY, finished=RESULTS), tmp_path)
    assert {statuses[name].state for name in RESULTS} == {progress.CellState.FINISHED}


@pytest.fixture
def few_draws(monkeypatch):
    """Intervals from fewer draws, which are faster."""
    monkeypatch.setattr(statistics, "DRAWS", 100)
    statistics._counts.cache_clear()
    yield
    statistics._counts.cache_clear()


@pytest.mark.usefixtures("few_draws")
def test_tables_show_what_has_run():
    made = page.blocks(RESULTS)
    assert _rows(made["ranks"])[6] == ["64", "47.5", "52.1", "+4.6", "0.001", "0.001"]
    lacking = {name: r for name, r in RESULTS.items() if name != "pi0/mt50/lora_sp/s1"}
    fewer = page.blocks(lacking)
    assert fewer["ml5"] == made["ml5"]
    pi0, smolvla = fewer["mt50"].split("\n\n")
    assert pi0.count("–") == 5 * 9
    assert smolvla in made["mt50"]
    for table in page.blocks({}).values():
        assert not re.search(r"\d\.\d", table)


def forgetting(kind, tasks):
    """Outcomes of a policy by number of learned tasks and task, of those that are judged.

    Of a task's episodes, 10 % succeed in the base, 20 % right before it, 80 % right after it, and
    60 % at the end, or 70 % with a kind of LoRA-SP.
    """
    end = 0.6 if KINDS[kind][0] == "lora" else 0.7
    found = {}
    for k, task in enumerate(tasks, 1):
        rates = {0: 0.1, len(tasks): end, k: 0.8} | ({k - 1: 0.2} if k > 1 else {})
        found |= {f"{done}/{task}": "1" * round(20 * r) for done, r in rates.items()}
    return {name: digits.ljust(20, "0") for name, digits in found.items()}


@pytest.mark.usefixtures("few_draws")
def test_tables_compare_numbers_of_tasks_and_ranks():
    """LoRA-SP leads r = 64 by 10 points with 5 tasks and 30 with 50, alone by none."""
    wins = {"first5": 60, "first10": 60, "first25": 60, "mt50": 80}
    results = {}
    for cell in STUDY.cells:
        _, kind, method, _ = cell.name.split("/")
        if isinstance(cell, Derived):
            tasks = page.SEQUENCES.orders[int(method[1])]
            results[cell.name] = {"outcomes": forgetting(kind, tasks)}
            results[cell.name] |= {"protected": [0.25, 0.5]} if kind == "protected" else {}
            continue
        rate = wins.get(kind, 40) if method.startswith("lora_sp") else 50 if kind in wins else 40
        stage = study.STAGES[kind]
        digits = ("1" * (rate // 10)).ljust(10, "0") * 10
        config = {"optim": {"learning_rate": 1e-3}}
        outcomes = dict.fromkeys(SETS[stage.tasks], digits[: stage.episodes])
        results[cell.name] = {"outcomes": outcomes, "config": config, "active_rank": {}}
        results[cell.name] |= {"trainable_parameters": 1, "total_parameters": 2}
    made = page.blocks(results)
    sizes, shared, ranks = (_rows(made[name]) for name in ("sizes", "shared", "ranks"))
    assert sizes[5] == ["50", "50.0", "50.0", "80.0", "+30.0", "+30.0", "+20.0"]
    assert shared[3] == ["10, as many steps a task", "40.0", "40.0", "+0.0", "+0.0", "+0.0"]
    assert shared[4] == ["5", "50.0", "60.0", "+10.0", "+20.0", "+10.0"]
    assert ranks[2][:4] == ["4", "50.0", "80.0", "+30.0"]
    assert ranks[8][1:4] == ["0.0", "0.0", "+0.0"]
    rows = {row[0]: row[1:] for row in _rows(made["sequences"])}
    assert rows["LoRA, all tasks together"] == ["40.0", *["–"] * 7, "3"]
    lora = ["62.0", "+22.0", "80.0", "80.0", "+20.0", "–", "+10.0", "–", "3"]
    assert rows["LoRA"] == lora
    lora_sp = ["71.0", "+31.0", "80.0", "80.0", "+10.0", "−10.0", "+10.0", "–", "3"]
    assert rows["LoRA-SP"] == lora_sp
    protected = [*lora_sp[:5], "+0.0", "+10.0", "50 %", "3"]
    assert rows["LoRA-SP, used directions protected"] == protected
    assert rows["one LoRA per task, r = 64"] == ["80.0", "+40.0", "80.0", *["–"] * 5, "3"]


def test_sequences_begin_with_what_learned_the_same_tasks_together():
    cells = [cell for cell in STUDY.cells if isinstance(cell, Derived)]
    assert len(cells) == 2 * 3 * (2 * 6 + 1)
    for cell in cells:
        backbone, kind, order, seed = cell.name.split("/")
        method = {"lora": "lora_r64", "lora_sp": "lora_sp"}[KINDS[kind][0]]
        assert cell.source == f"{backbone}/together/{method}/{seed}"
        tasks = SETS["first10"][:: -1 if order == "o1" else 1]
        assert cell.settings["tasks"] == [*tasks]
        optim = STUDY[cell.source].config(RESULTS).optim
        assert optim.steps == len(tasks) * study.STEPS_ALONE
        assert cell.settings["rate"] == (None if kind == "single" else optim.learning_rate)


@pytest.fixture
def demonstrated(tmp_path):
    """The cache of a run of three tasks, of which each has two episodes of its own lengths."""
    tasks, rng = page.SEQUENCES.orders[0][:3], np.random.default_rng(0)
    writer = dataset.Writer(tmp_path / "data", 8)
    for length, task in enumerate(tasks, 3):
        picture = dataset.png(np.full((8, 8, 3), length, np.uint8))
        numbers = rng.uniform(-1, 1, (2, length, 4)).astype(np.float32)
        writer.add_task(INSTRUCTIONS[task], [([picture] * length, *numbers)] * 2)
    writer.close()
    folder = tmp_path / "pi0/together/lora_r64/s0" / CACHE
    folder.parent.mkdir(parents=True)
    caches.write([open_source(tmp_path / "data")], folder, lambda *_: None)


@pytest.mark.usefixtures("demonstrated")
@pytest.mark.parametrize("kind", ["sequential", "replay", "single"])
def test_a_sequence_learns_each_task_from_its_demonstrations(kind, tmp_path, monkeypatch):
    tasks, drawn, shown = page.SEQUENCES.orders[0][:3], [], []
    made = make_run(tmp_path / "run", dataclasses.replace(CONFIG, peft=peft.LoRA(rank=2)))
    made.folder = tmp_path / "pi0" / kind / "o0" / "s0"

    def train(stage):
        drawn.append(
            sorted({int(stage.dataset.image["corner2"][i, 0, 0, 0]) for i in starts(stage)})
        )
        drawn[-1].append(stage.steps.num_starts)
        return stage.policy

    def evaluate(run, tasks, episodes, first_seed):
        assert (run.policy.processor, episodes, first_seed) == (made.policy.processor, 5, 0)
        shown.append([*tasks])
        return dict.fromkeys(tasks, "01")

    monkeypatch.setattr(sequences, "outcomes", evaluate)
    three = dataclasses.replace(page.SEQUENCES, orders=(tasks,))
    monkeypatch.setattr(page, "SEQUENCES", three)
    monkeypatch.setattr(learning.loop, "trained", train)
    built = SimpleNamespace(model=made.policy.model)
    monkeypatch.setattr(learning.setup, "build", lambda *_: built)
    found = sequences.judge(made, kind, 0, 5)["outcomes"]
    first, second, third = tasks
    if kind == "replay":  # one of the two episodes of each earlier task
        assert drawn == [[3, 6], [3, 4, 3 + 8], [3, 4, 5, 3 + 4 + 10]]
    else:
        assert drawn == [[3, 6], [4, 8], [5, 10]]
    if kind == "single":
        assert shown == [[first], [second], [third]]
        assert [*found] == [f"1/{first}", f"2/{second}", f"3/{third}"]
    else:
        assert shown == [[*tasks], [first, second], [second, third], [*tasks]]
        assert {f"1/{second}", f"0/{third}", f"3/{first}"} < {*found}


def starts(stage):
    """Return the steps at which a run's windows may start."""
    return stage.steps.start(np.arange(stage.steps.num_starts))


def _rows(table):
    """Return the values of every row, without their intervals."""
    lines = table.replace("\u00a0", " ").splitlines()
    return [[c.split(" [")[0].strip() for c in line.strip("|").split("|")] for line in lines]


def test_runs_have_the_settings_in_the_results():
    kinds = {"lora_sp": peft.LoRASP, "ada_lora": peft.AdaLoRA, "full": peft.FullFineTuning}
    for cell in (STUDY[name] for name in RESULTS):
        config = cell.config(RESULTS) if callable(cell.config) else cell.config
        recorded = RESULTS[cell.name]["config"]
        assert changed_settings(recorded, describe_config(cell, config)) == ["name"]
        backbone, stage, method, _ = cell.name.split("/")
        assert type(config.peft) is kinds.get(re.sub(r"sp_r\d+", "sp", method), peft.LoRA)
        assert config.data.source == (f"data/{study.STAGES[stage].tasks}",)
        base = f"runs/metaworld/{backbone}/ml45/full/s0/base"
        bundled = f"assets/{backbone}_small"
        assert config.model.source == (base if stage == "ml5" else bundled)
        assert bool(cell.source) == (stage == "ml5")


def test_rate_is_that_of_the_best_pilot():
    pilots = study._pilots("pi0/mt50/lora_r16/s0")
    assert {name.split("/")[2] for name in pilots} == {"lora_r64"}
    outcomes = {"reach": "0011"}, {"reach": "1111"}, {"reach": "0111"}
    found = {name: {"outcomes": o} for name, o in zip(pilots, outcomes, strict=True)}
    assert files.best_rate(found, pilots) == 1e-3


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run whose judge asks the server once, and writes down its options and the reply's shape."""
    made = make_run(tmp_path / "run")
    log = MetricsLog(made.folder)
    log.write(1, {"active_rank/vision": 3.25, "active_rank/vision/q_proj": 9.0, "task": 1.0})
    log.close()
    (tmp_path / "python").write_text(
        f"#!{sys.executable}\n"
        "import json, pathlib, sys\n"
        "import numpy as np\n"
        "from lorasp_jax.extras.judge import __main__ as judging\n"
        "from lorasp_jax.extras.serving.client import PolicyClient\n"
        "options = judging.parser('').parse_args(sys.argv[3:])\n"
        "with PolicyClient(options.server) as server:\n"
        "    picture = np.zeros((32, 32, 3), np.uint8)\n"
        "    images = dict.fromkeys(server.metadata['cameras'], picture)\n"
        "    state = np.zeros(7, np.float32)\n"
        "    request = {'image': images, 'state': state, 'prompt': 'press the button'}\n"
        "    actions = np.asarray(server.infer(request)['actions'])\n"
        "    said = [sys.argv[3:], [*actions.shape], server.metadata['denoise_steps']]\n"
        f"pathlib.Path({str(tmp_path)!r}, 'judge.txt').write_text(json.dumps(said))\n"
        "tasks = {'door-lock': {'outcomes': [True, False]}}\n"
        "options.out.write_text(json.dumps({'tasks': tasks}))\n"
    )
    (tmp_path / "python").chmod(0o755)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv(judge.PYTHON, str(tmp_path / "python"))
    monkeypatch.setattr(judge, "PROCESSES", 1)
    return made


def test_a_policy_is_served_and_judged(run, tmp_path):
    found = judge.judge("ml5", 2, 7, run)
    assert found["outcomes"] == {"door-lock": "10"}
    assert found["active_rank"] == {"vision": 3.25}
    assert 0 < found["trainable_parameters"] < found["total_parameters"]
    given, shape, steps = json.loads((tmp_path / "judge.txt").read_text())
    options = judging.parser("").parse_args(given)
    assert (options.tasks, options.episodes, options.seed) == ([*HELD_OUT], 2, 7)
    assert options.out == run.folder / "judged.json"
    assert shape == [run.policy.model.config.chunk, 7]
    assert steps == {"run": run.config.evaluation.denoise_steps}
    assert judge.judge("ml5", 2, 7, run) == found  # again, although there is a file
    (tmp_path / "judge.txt").unlink()
    assert judge.judge("ml45", 0, 0, run)["outcomes"] == {}
    assert not (tmp_path / "judge.txt").exists()


def test_failures_are_named(run, monkeypatch):
    monkeypatch.setenv(judge.PYTHON, "false")
    with pytest.raises(ValueError, match="judging failed with exit code 1"):
        judge.judge("ml5", 2, 7, run)
    monkeypatch.delenv(judge.PYTHON)
    with pytest.raises(ValueError, match=judge.PYTHON):
        judge.judge("ml5", 2, 7, run)
