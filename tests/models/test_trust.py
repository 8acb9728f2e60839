"""Untrusted model folders cannot refer to other folders, hang a reader or exhaust memory."""

import dataclasses
import json
import os

import numpy as np
import orbax.checkpoint as ocp
import pytest

from lorasp_jax.base.files import TEXT_BYTES
from lorasp_jax.models.checkpoints import layouts, loading, native, published
from lorasp_jax.models.checkpoints.tensor_files import INDEX, SINGLE, TensorFiles, weight_files
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.policies import statistics_files, tokenizer

READERS = {
    "config.json": [loading.load_config, native.load_config],
    SINGLE: [lambda folder: TensorFiles(weight_files(folder)), statistics_files.read],
    INDEX: [weight_files],
    "tokenizer.json": [tokenizer.load_tokenizer],
    "x.model": [tokenizer.load_tokenizer],
    "norm_stats.json": [statistics_files.read],
}


@pytest.mark.parametrize("name", READERS)
def test_a_pipe_is_refused(name, tmp_path):
    os.mkfifo(tmp_path / name)
    for read in READERS[name]:
        with pytest.raises(ValueError, match=str(tmp_path)):
            read(tmp_path)


@pytest.mark.parametrize("content", [[], {"weight_map": None}, {"weight_map": {"a": "b", "c": 3}}])
def test_an_index_of_another_form(content, tmp_path):
    (tmp_path / INDEX).write_text(json.dumps(content))
    with pytest.raises(ValueError, match=rf"{INDEX} is damaged .*(must be|lacks)"):
        weight_files(tmp_path)


@pytest.mark.parametrize("name", ["../x.safetensors", "/etc/passwd", "", ".", 3])
def test_file_names_must_stay_in_the_folder(name, tmp_path):
    (tmp_path / "x.safetensors").write_bytes(b"")
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / INDEX).write_text(json.dumps({"weight_map": {"a": name}}))
    with pytest.raises(ValueError, match=str(folder)):
        TensorFiles(weight_files(folder))
    steps = [{"registry_name": "normalizer_processor", "state_file": name}]
    for pipeline in statistics_files.PIPELINES:
        (folder / pipeline).write_text(json.dumps({"steps": steps}))
    with pytest.raises(ValueError, match=str(folder)):
        statistics_files.read(folder)


def test_arrays_larger_than_their_files(tmp_path):
    """Missing Zarr chunks are read as zeros."""
    handler = ocp.PyTreeCheckpointHandler(use_ocdbt=False)
    tree = {"params": {"a": np.ones((2, 3), np.float32)}}
    ocp.Checkpointer(handler).save(tmp_path / "params", tree)
    assert published._restore(tmp_path / "params")["a"].shape == (2, 3)
    (header,) = (tmp_path / "params").rglob(".zarray")
    header.write_text(json.dumps(json.loads(header.read_text()) | {"shape": [10**6, 10**6]}))
    with pytest.raises(ValueError, match=r"params would take .* GiB of memory"):
        published._restore(tmp_path / "params")


def test_deeply_nested_json_and_huge_numbers(tmp_path):
    for text in ("[" * 100_000, '{"state_mean": [' + "9" * 400 + "]}"):
        (tmp_path / "statistics.json").write_text(text)
        with pytest.raises(ValueError, match="statistics"):
            statistics_files.read(tmp_path)
        (tmp_path / "config.json").write_text("[" * 100_000)
        with pytest.raises(ValueError, match=r"config.json is damaged"):
            loading.load_config(tmp_path)


def test_text_files_that_are_too_large(tmp_path):
    for name, read in (("config.json", loading.load_config), (INDEX, weight_files)):
        with (tmp_path / name).open("wb") as file:
            file.truncate(TEXT_BYTES + 1)  # sparse: takes no disk space
        with pytest.raises(ValueError, match=name):
            read(tmp_path)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e60, 3, True])
def test_weights_must_be_floating_point_and_finite(value):
    rule = layouts.copied("ours", "theirs")
    theirs = {"theirs": np.array([1, value, 2])}
    with pytest.raises(ValueError, match="theirs of x"):
        layouts.to_ours([rule], theirs, {"ours": (3,)}, "x", lambda name, array: array)


def test_a_tokenizer_that_is_too_large(tmp_path):
    for name in ("tokenizer.json", "x.model"):
        (tmp_path / name).touch()
        os.truncate(tmp_path / name, 2**40)
        with pytest.raises(ValueError, match=name):
            tokenizer.load_tokenizer(tmp_path / name)


@pytest.mark.parametrize("name", ["dtype", "param_dtype", "inputs", "remat", "unroll"])
@pytest.mark.parametrize("value", [5, "x", [1]])
def test_config_fields_of_the_wrong_type(name, value):
    fields = dataclasses.asdict(Pi0Config.dummy())
    with pytest.raises((ValueError, TypeError, AttributeError)):
        Pi0Config.from_dict(fields | {name: value})


def test_a_sparse_tensor_larger_than_memory(tmp_path):
    """A sparse file of 1 TiB with a single tensor."""
    header = {"hole": {"dtype": "BF16", "shape": [2**39], "data_offsets": [0, 2**40]}}
    text = json.dumps(header).encode()
    path = tmp_path / "model.safetensors"
    path.write_bytes(len(text).to_bytes(8, "little") + text)
    os.truncate(path, 8 + len(text) + 2**40)
    tensors = TensorFiles([path])
    with pytest.raises(ValueError, match=r"hole .* memory"):
        tensors["hole"]
