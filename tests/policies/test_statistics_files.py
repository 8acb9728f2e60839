"""Read files built by hand from the documented formats of openpi and LeRobot."""

import json

import numpy as np
import pytest
import safetensors.numpy

from lorasp_jax.policies import statistics_files
from lorasp_jax.policies.statistics import NAMES, Statistics
from tests.data.lerobots import golden

RNG = np.random.default_rng(0)
STATE, ACTION = RNG.uniform(size=(2, len(NAMES), 7)).astype(np.float32)
for values in (STATE, ACTION):
    for low in (2, 4, 6):  # min and max, q01 and q99, q10 and q90
        values[low : low + 2].sort(axis=0)


def by_name(values, names=NAMES):
    return {name: values[NAMES.index(name)] for name in names}


def lists(values, names=NAMES):
    return {name: array.tolist() for name, array in by_name(values, names).items()}


def assert_statistics(actual: Statistics, names=NAMES, scale=1):
    for stats, values in ((actual.state, STATE), (actual.action, ACTION)):
        assert stats.keys() == set(names)
        for name, array in by_name(values * scale, names).items():
            np.testing.assert_array_equal(stats[name], array, err_msg=name)


def norm_stats(scale=1):
    """An openpi file; older ones have null for the quantiles."""
    names = ("mean", "std", "q01", "q99")
    both = {"state": lists(STATE * scale, names), "actions": lists(ACTION * scale, names)}
    return json.dumps({"norm_stats": both})


def test_openpi(tmp_path):
    for name, scale in (("trossen", 1), ("physical-intelligence/libero", 2)):
        (tmp_path / "assets" / name).mkdir(parents=True)
        (tmp_path / "assets" / name / "norm_stats.json").write_text(norm_stats(scale))
    (tmp_path / "norm_stats.json").write_text(norm_stats(3))  # openpi does not read it there
    names = ("mean", "std", "q01", "q99")
    assert_statistics(statistics_files.read(tmp_path, dataset="trossen"), names)
    libero = statistics_files.read(tmp_path, dataset="physical-intelligence/libero")
    assert_statistics(libero, names, scale=2)
    file = tmp_path / "assets" / "trossen" / "norm_stats.json"
    assert_statistics(statistics_files.read(file), names)
    assert_statistics(statistics_files.read(file.parent), names)
    with pytest.raises(ValueError, match="libero', 'trossen'"):
        statistics_files.read(tmp_path)
    old = json.loads(norm_stats())
    old["norm_stats"]["state"] |= {"q01": None, "q99": None}
    old["norm_stats"]["actions"] |= {"q01": None, "q99": None}
    file.write_text(json.dumps(old))
    assert_statistics(statistics_files.read(file), names[:2])


def test_lerobot_dataset_by_episode():
    """Aggregated per-episode statistics of version 2.1 equal those of the same data in 3.0."""
    actual, expected = (statistics_files.read(golden(version)) for version in ("v21", "v3"))
    for kind in ("state", "action"):
        stats = getattr(actual, kind)
        assert set(stats) == {"mean", "std", "min", "max"}
        for name, array in stats.items():
            np.testing.assert_allclose(array, getattr(expected, kind)[name], rtol=2e-6, atol=1e-7)


@pytest.mark.parametrize(
    "change",
    [
        *[{"count": count} for count in ([0], [1e999], 5, [5, 5], [-5])],
        *[{"mean": [0.0]}, {"std": ["x"] * 7}, {"min": None}, {"max": [[0.0]] * 7}],
    ],
)
def test_damaged_lerobot_episodes(change, tmp_path):
    (row,) = (golden("v21") / "meta" / "episodes_stats.jsonl").read_text().splitlines()[:1]
    row = json.loads(row)
    row["stats"]["action"] |= change
    (tmp_path / "episodes_stats.jsonl").write_text(json.dumps(row))
    with pytest.raises(ValueError, match=r"episodes_stats|statistics"):
        statistics_files.read(tmp_path)


def test_lerobot_dataset(tmp_path):
    (tmp_path / "meta").mkdir()
    extra = {"count": [126], "q50": [0.0] * 7}
    stats = {
        "observation.images.side": {"mean": [[[0.4]], [[0.4]], [[0.3]]]},
        "observation.state": {**lists(STATE), **extra},
        "action": {**lists(ACTION), **extra},
    }
    (tmp_path / "meta" / "stats.json").write_text(json.dumps(stats))
    assert_statistics(statistics_files.read(tmp_path))
    assert_statistics(statistics_files.read(tmp_path / "meta" / "stats.json"))


def test_ours(tmp_path):
    path = tmp_path / "statistics.json"
    both = {f"state_{k}": v for k, v in lists(STATE).items()}
    both |= {f"action_{k}": v for k, v in lists(ACTION).items()}
    path.write_text(json.dumps(both))
    assert_statistics(statistics_files.read(tmp_path))


def policy(folder, pre, post):
    """Write a policy folder with the tensors of both processors."""
    for kind, number, tensors in (("pre", 5, pre), ("post", 0, post)):
        step = f"{'un' * (kind == 'post')}normalizer_processor"
        file = f"policy_{kind}processor_step_{number}_{step}.safetensors"
        safetensors.numpy.save_file(tensors, folder / file)
        steps = [
            {"registry_name": "to_batch_processor", "config": {}},
            {"registry_name": step, "config": {"eps": 1e-08}, "state_file": file},
        ]
        (folder / f"policy_{kind}processor.json").write_text(json.dumps({"steps": steps}))
    return folder


def tensors(prefix="", separator=".", names=NAMES):
    state = {
        f"{prefix}observation{separator}state.{k}": v for k, v in by_name(STATE, names).items()
    }
    return state | {f"{prefix}action.{k}": v for k, v in by_name(ACTION, names).items()}


def test_lerobot_policy(tmp_path):
    pre = {**tensors(), "observation.state.count": np.array([126])}
    of_a_dataset = {name: lists(STATE + 1) for name in ("observation.state", "action")}
    (tmp_path / "stats.json").write_text(json.dumps(of_a_dataset))
    assert_statistics(statistics_files.read(policy(tmp_path, pre, tensors())))
    other = {**tensors(), "action.mean": ACTION[0] + 1}
    with pytest.raises(ValueError, match=r"action\.mean"):
        statistics_files.read(policy(tmp_path, pre, other))
    several = tensors("so100.buffer.", names=("mean", "std"))
    selected = statistics_files.read(policy(tmp_path, several, several), dataset="so100")
    assert_statistics(selected, ("mean", "std"))
    with pytest.raises(ValueError, match="statistics"):
        statistics_files.read(policy(tmp_path, {"x": STATE}, {"x": STATE}))


@pytest.mark.parametrize("dataset", ["", "so100"])
def test_older_lerobot_policy(tmp_path, dataset):
    """Statistics are stored among the weights, for one or several datasets."""
    buffers = {"model.state_proj.bias": np.zeros(3, np.float32)}
    for name in {dataset, f"{dataset}-red"} if dataset else {""}:
        prefix = f"{name}_buffer_" if name else "buffer_"
        scale = np.float32(1 + (name != dataset))
        for key, array in tensors(prefix, "_", ("min", "max")).items():
            modules = ["normalize_targets", "unnormalize_outputs"]
            for module in modules if "action" in key else ["normalize_inputs"]:
                buffers[f"{module}.{key}"] = array * scale
    safetensors.numpy.save_file(buffers, tmp_path / "model.safetensors")
    assert_statistics(statistics_files.read(tmp_path, dataset=dataset), ("min", "max"))
    if dataset:
        with pytest.raises(ValueError, match=r"'so100', 'so100-red'.* 'aloha'"):
            statistics_files.read(tmp_path, dataset="aloha")


def test_invalid_files_raise_one_sentence(tmp_path):
    with pytest.raises(ValueError, match=r"statistics\.json, assets"):
        statistics_files.read(tmp_path)
    path = tmp_path / "norm_stats.json"
    for text in ("{", "{}", '{"norm_stats": {"state": 3, "actions": 4}}'):
        path.write_text(text)
        with pytest.raises(ValueError, match="norm_stats"):
            statistics_files.read(path)
    unset = json.loads(norm_stats())
    unset["norm_stats"]["state"]["mean"][0] = float("inf")
    path.write_text(json.dumps(unset))
    with pytest.raises(ValueError, match=r"mean\[0\] must be a number, got inf"):
        statistics_files.read(path)
    for name, values in (("q01", [9.0] * 7), ("mean", {}), ("mean", [True] * 7), ("mean", 1.0)):
        wrong = json.loads(norm_stats())
        wrong["norm_stats"]["state"][name] = values
        path.write_text(json.dumps(wrong))
        with pytest.raises(ValueError, match=rf"norm_stats\.json.* {name} above|state\.{name}"):
            statistics_files.read(path)
    unset["norm_stats"]["state"] |= {"mean": [0.0] * 7, "std": [1.0] * 6 + [-1e-3]}
    path.write_text(json.dumps(unset))
    with pytest.raises(ValueError, match="std"):
        statistics_files.read(path)
