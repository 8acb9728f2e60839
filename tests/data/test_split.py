"""Episodes are held out evenly, and every task keeps some to learn from."""

import pytest

from lorasp_jax.data.split import held_out

TASKS = 20 * ["pour"] + 10 * ["press"]


@pytest.mark.parametrize(
    ("choice", "expected"),
    [
        (["auto"], [5, 15, 25]),
        (["0.1"], [5, 15, 25]),
        (["0.2"], [2, 7, 12, 17, 22, 27]),
        (["3"], [5, 15, 25]),
        (["0"], []),
        (["0.001"], [10]),
        (["episode_3", "episode_000017"], [3, 17]),
    ],
)
def test_choices(choice, expected):
    assert held_out(choice, TASKS, recorded=True) == expected


def test_auto_needs_recordings_and_enough_of_them():
    assert held_out(["auto"], TASKS, recorded=False) == []
    assert held_out(["auto"], 9 * ["pour"], recorded=True) == []


def test_a_task_of_one_episode_is_learned_from():
    assert held_out(["0.5"], ["a", "b", "c", "d", "d", "d", "d"], recorded=True) == [4, 6]


@pytest.mark.parametrize(
    ("choice", "named"),
    [
        (["30"], "leave some of the 30 episodes that there are.*got 30"),
        (["0.01", "x"], "episode_29"),
        (["1.5"], r"1\.5"),
        (["-1"], "-1"),
        (["nan"], "episode_0 to episode_29.*nan"),
        (["0.1", "0.2"], "one number"),
        (["episode_30"], "episode_29.*episode_30"),
        (["episode_1", "0.1"], "episode_29"),
        ([], "one number"),
        ([f"episode_{n}" for n in range(20, 30)], "press"),
    ],
)
def test_impossible_choices(choice, named):
    with pytest.raises(ValueError, match=named):
        held_out(choice, TASKS, recorded=True)


def test_what_cannot_be_held_out_is_said():
    with pytest.raises(ValueError, match="every task"):
        held_out(["3"], [f"task {number}" for number in range(20)], recorded=True)


def test_instructions_of_a_task_are_held_out_alike():
    phrases = ["red", "blue"] * 25
    for number in ("0.1", "8", "20"):
        chosen = held_out((number,), ["desk"] * 50, phrases, recorded=True)
        counts = [sum(phrases[n] == phrase for n in chosen) for phrase in ("red", "blue")]
        assert abs(counts[0] - counts[1]) <= 1, chosen


def test_an_instruction_keeps_an_episode_while_others_have_more():
    phrases = ["red"] * 9 + ["blue"]
    for count in range(1, 9):
        assert 9 not in held_out((str(count),), ["desk"] * 10, phrases, recorded=True)
    unique = [str(number) for number in range(10)]
    assert len(held_out(("3",), ["desk"] * 10, unique, recorded=True)) == 3
