"""A head is the same after saving and loading, and refused for any other policy."""

import dataclasses
import json

import jax
import numpy as np
import pytest
import safetensors.numpy
from flax import nnx

from lorasp_jax.policies.correction import CorrectionHead
from lorasp_jax.training.correction import files
from lorasp_jax.training.run_folder import read_json, write_json
from tests.evaluation.test_programs import policy

POLICY = policy()
CONFIG = POLICY.model.config


@pytest.fixture(scope="module")
def head():
    """A random head."""
    head = CorrectionHead(("front",), CONFIG.action_dim, CONFIG.chunk, nnx.Rngs(3))
    head.out.kernel[...] = jax.random.normal(jax.random.key(1), head.out.kernel.shape)
    return head


@pytest.fixture
def folder(tmp_path, head):
    """A run with a head."""
    files.save(tmp_path, head, POLICY, {"naive": 2.0, "corrected": 1.0})
    return tmp_path


def refused(folder, policy=POLICY):
    """Return the sentence with which a head is refused."""
    with pytest.raises(ValueError, match=f"lorasp-jax correction {folder}$") as caught:
        files.load(folder, policy)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_round_trip(folder, head):
    loaded = files.load(folder, POLICY)
    for name in ("cameras", "action_dim", "chunk"):
        assert getattr(loaded, name) == getattr(head, name)
    before, after = (jax.tree.leaves(nnx.state(h)) for h in (head, loaded))
    assert len(before) == len(after) == 12
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one, other)
    assert files.describe(folder)["error"] == {"naive": 2.0, "corrected": 1.0}


def test_a_run_without_a_head(tmp_path):
    assert f"{tmp_path} has no correction head: train one" in refused(tmp_path)


def test_a_head_of_another_policy(folder):
    assert "was trained for another policy" in refused(folder, policy(weight=0.25))


@pytest.mark.parametrize(("name", "sizes"), [("chunk", "5 x 8"), ("action_dim", "4 x 9")])
def test_a_head_for_other_chunks(folder, name, sizes):
    config = dataclasses.replace(CONFIG, **{name: getattr(CONFIG, name) + 1})
    other = dataclasses.replace(POLICY, model=dataclasses.replace(POLICY.model, config=config))
    expected = f"is for chunks of 4 x 8 numbers, but the policy's have {sizes}"
    assert expected in refused(folder, other)


def test_damaged_tensors(folder):
    path = folder / files.TENSORS
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    assert f"{path} is damaged (the checksum does not match)" in refused(folder)
    path.unlink()
    assert f"{path} is missing" in refused(folder)


def test_tensors_of_another_version(folder):
    tensors = {"out/bias": np.zeros(8, np.float32)}
    data = safetensors.numpy.save(tensors)
    (folder / files.TENSORS).write_bytes(data)
    saved = read_json(folder / files.DESCRIPTION)
    write_json(
        folder / files.DESCRIPTION, saved | {"sha256": files.hashlib.sha256(data).hexdigest()}
    )
    assert "its tensors are those of another version" in refused(folder)


def test_a_damaged_description(folder):
    path = folder / files.DESCRIPTION
    path.write_text(path.read_text().replace('"chunk": 4', '"chunk": 6'))
    with pytest.raises(ValueError, match=r"correction.json is damaged \(the digest does not match"):
        files.load(folder, POLICY)
    saved = json.loads(path.read_text())
    write_json(path, {name: saved[name] for name in ("policy", "chunk")})
    with pytest.raises(ValueError, match="lacks 'sha256'"):
        files.load(folder, POLICY)
