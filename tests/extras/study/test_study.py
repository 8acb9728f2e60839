import pytest

from lorasp_jax.config import Config
from lorasp_jax.extras.study import Cell, Derived, Study
from lorasp_jax.peft import LoRA

CONFIG = Config(name="cell", scale="smoke", peft=LoRA(rank=2))


def cell(name, *after, group=""):
    return Cell(name, CONFIG, after, group)


def cut(name, source, *after):
    return Derived(name, source, lambda policy, results, episodes: policy, after)


def test_groups_keep_the_order_of_cells():
    cells = (
        cell("a/s0", group="a"),
        cell("b/s0", group="b"),
        cell("a/s1", group="a"),
        cell("c"),
        cut("cut/s0", "a/s0", "b/s0"),
    )
    groups = {
        group: [cell.name for cell in cells] for group, cells in Study("x", cells).groups.items()
    }
    assert groups == {"a": ["a/s0", "a/s1", "cut/s0"], "b": ["b/s0"], "c": ["c"]}


@pytest.mark.parametrize("name", ["pi0/multi/lora_sp/s0", "r=2", "a.b", "0", "eta_.9"])
def test_valid_names(name):
    assert Study("x", (cell(name),))[name].name == name


@pytest.mark.parametrize(
    "name",
    ["", "/a", "a/", "a//b", "../a", "a/..", ".a", "a/.b", "a*", "a b", "ä", "a\n", "x" * 201],
)
def test_unsafe_names_are_refused(name):
    with pytest.raises(ValueError, match="relative paths of letters"):
        Study("x", (cell(name),))
    with pytest.raises(ValueError, match="relative paths of letters"):
        Study(name, ())


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ([cell("demonstrations/a")], "names must not begin with demonstrations"),
        ([cell("a"), cell("a")], "two cells have the name 'a'"),
        ([cell("a/b"), cell("a")], "cell 'a/b' lies in the folder of cell 'a'"),
        ([cell("a", "b")], "cell 'a' needs 'b', which does not exist"),
        ([cell("a", "b"), cell("b", "a")], "cell 'a' needs 'b', which comes later"),
        ([cell("a", "a")], "cell 'a' needs 'a', which comes later"),
        ([cut("a", "b")], "cell 'a' needs 'b', which does not exist"),
    ],
)
def test_inconsistent_cells_are_refused(cells, message):
    with pytest.raises(ValueError, match=message):
        Study("x", tuple(cells))


def test_study_name_is_one_folder():
    with pytest.raises(ValueError, match="must not contain '/'"):
        Study("a/b", ())
