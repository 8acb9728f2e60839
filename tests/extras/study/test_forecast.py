"""Expected times of cells, and which cells can still run."""

import dataclasses

import pytest

from lorasp_jax.config import OptimConfig
from lorasp_jax.extras.study import Cell, Study, forecast
from lorasp_jax.extras.study.status import State, Status
from lorasp_jax.peft import LoRA
from tests.extras.study import fakes
from tests.extras.study.fakes import CONFIG, NAMES

LORA = dataclasses.replace(CONFIG, peft=LoRA(rank=8))


def finished(seconds, config=CONFIG):
    return Status(State.FINISHED, "", config, {"seconds": {"total": seconds}})


def runnable(config=CONFIG):
    return Status(State.RUNNABLE, "", config)


def seconds(statuses, **options):
    study = Study("fake", tuple(Cell(name, CONFIG) for name in statuses))
    return forecast.seconds(study, statuses, **options)


def test_a_cell_takes_as_long_as_its_kind_or_else_as_any():
    long = dataclasses.replace(CONFIG, optim=OptimConfig(steps=7))
    statuses = {"a": finished(10.0), "b": finished(20.0), "c": finished(60.0, LORA)}
    statuses |= {"d": runnable(), "e": runnable(LORA), "f": runnable(long)}
    expected = {"a": 10, "b": 20, "c": 60, "d": 15, "e": 60, "f": 30}
    assert seconds(statuses) == expected
    waiting = Status(State.WAITING, "for d", guess=LORA)
    assert seconds(statuses | {"f": waiting})["f"] == 60
    assert seconds({"a": runnable()}) == {}


def test_jobs_share_the_device():
    statuses = {"a": finished(10.0), "b": finished(30.0, LORA), "c": runnable(LORA)}
    assert seconds(statuses, jobs=4)["c"] == 120  # as long as nobody knows
    statuses |= {"d": finished(15.0), "e": runnable()}
    times = seconds(statuses, jobs=4, recent=["d"])
    assert (times["a"], times["e"]) == (10, 15)
    assert times["c"] == 45  # like `d`, half as long again
    assert seconds({"d": finished(15.0), "e": runnable()}, jobs=4, recent=["d"])["e"] == 15


def left(*, names=NAMES, states=(State.RUNNABLE,), **changes):
    waiting = {name: Status(State.WAITING) for name in ("lora/s0", "lora/s1", "cut/s0")}
    statuses = dict.fromkeys(NAMES, runnable()) | waiting
    statuses |= {name.replace("_", "/"): status for name, status in changes.items()}
    return forecast.left(fakes.study(), names, statuses, states)


def test_what_waits_for_a_failed_cell_is_not_left():
    failed = Status(State.FAILED)
    assert sorted(left()) == sorted(NAMES)
    assert left(sp_s0=finished(1.0), sp_s1=failed) == ["lr"]
    assert left(lora_s0=failed) == ["sp/s0", "sp/s1", "lora/s1", "lr"]
    assert sorted(left(lora_s0=failed, states=[State.RUNNABLE, State.FAILED])) == sorted(NAMES)
    assert left(lora_s0=Status(State.CHANGED), names=["lora/s1", "sp/s0"]) == ["sp/s0"]


@pytest.mark.parametrize(
    ("seconds", "text"), [(119.4, "119 s"), (125, "2 min"), (7380, "2 h 3 min")]
)
def test_durations(seconds, text):
    assert forecast.duration(seconds) == text
