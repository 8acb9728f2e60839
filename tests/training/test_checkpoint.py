"""Checkpoints that were damaged, half written or had no room: used as saved, or refused aloud."""

import errno
import gc
import io
import resource
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from lorasp_jax.storage.digest import digest
from lorasp_jax.training.checkpoint import WRITTEN, Checkpoints
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.guard import Guard
from lorasp_jax.training.step import TrainState
from tests.runs import leaves

# Orbax leaves reads behind that nobody awaits when one of them fails.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
LARGE = (100, 80)  # more than what Orbax keeps among its own records


def state(step):
    key = jax.random.key(step)
    adapters = {"a": jax.random.normal(key, LARGE), "b": step * jnp.ones(3, jnp.bfloat16)}
    return TrainState(jnp.int32(step), adapters, {"mu": jnp.zeros(LARGE)}, Guard.initial())


@pytest.fixture(autouse=True)
def forgotten_reads():
    """They are complained about when their memory is collected: here."""
    yield
    gc.collect()


@pytest.fixture(scope="module")
def master(tmp_path_factory):
    """A folder with checkpoints of the steps 1 and 2."""
    folder = tmp_path_factory.mktemp("master")
    checkpoints = Checkpoints(folder, "base", Console(file=io.StringIO()))
    for step in (1, 2):
        checkpoints.save(state(step))
    checkpoints.close()
    return folder


@pytest.fixture
def folder(master, tmp_path):
    """A copy, which may be damaged."""
    return shutil.copytree(master, tmp_path / "run")


def restore(folder, base_hash="base"):
    """The step that is restored, whose state is what was saved then, and what is said."""
    console = Console(file=io.StringIO(), width=1000)
    checkpoints = Checkpoints(folder, base_hash, console)
    try:
        found = checkpoints.restore(state(0))
    finally:
        checkpoints.close()
    if found is None:
        return None, console.file.getvalue()
    for name, value in leaves(state(int(found.step))).items():
        np.testing.assert_array_equal(leaves(found)[name], value, err_msg=name)
    return int(found.step), console.file.getvalue()


def names(folder):
    return sorted(path.name for path in (folder / "checkpoints").iterdir())


def files(folder):
    found = sorted((folder / "checkpoints" / "2").rglob("*"))
    return [path.relative_to(folder) for path in found if path.is_file()]


def flipped(content, position):
    return content[:position] + bytes([content[position] ^ 0x10]) + content[position + 1 :]


def sweep(master, tmp_path, damages):
    """How often the damaged checkpoint itself was restored, and how often the one before."""
    steps = {1: 0, 2: 0}
    for file in files(master):
        content = (master / file).read_bytes()
        for damaged in damages(content):
            folder = shutil.copytree(master, tmp_path / "run")
            (folder / file).write_bytes(damaged)
            step, said = restore(folder)
            steps[step] += 1
            if step == 2:
                assert (said, names(folder)) == ("", ["1", "2"]), file
            else:
                assert "the checkpoint at step 2 is damaged, " in said, file
                assert said.endswith("2.damaged, and the run goes on from step 1\n"), file
                assert names(folder) == ["1", "2.damaged"], file
            shutil.rmtree(folder)
    return steps


def test_a_damaged_file_is_never_restored_as_something_else(master, tmp_path):
    def damages(content):
        return flipped(content, len(content) // 2), content[: len(content) // 2]

    steps = sweep(master, tmp_path, damages)
    assert steps[1] >= 10
    assert steps[2] >= 10  # what Orbax does not need is not missed


@pytest.mark.slow
def test_damage_anywhere(master, tmp_path):
    def damages(content):
        size, every = len(content), max(len(content) // 25, 1)
        yield from (flipped(content, position) for position in range(0, size, every))
        yield from (content[:cut] for cut in (0, 1, size // 3, size - 1))

    steps = sweep(master, tmp_path, damages)
    assert sum(steps.values()) > 400
    assert min(steps.values()) > 100


def test_what_is_damaged_twice_is_kept_twice(folder):
    for expected in (["1", "2.damaged"], ["1", "2.damaged", "2.damaged.1"]):
        (folder / "checkpoints/2/meta/metadata").write_text("{}")
        assert restore(folder)[0] == 1
        assert names(folder) == expected
        checkpoints = Checkpoints(folder, "base", Console(file=io.StringIO()))
        checkpoints.save(state(2))  # as the run does that goes on
        checkpoints.close()
        assert restore(folder) == (2, "")


def test_nothing_is_touched_where_all_are_damaged(folder):
    for step in (1, 2):
        (folder / f"checkpoints/{step}/meta/metadata").write_text("{}")
    with pytest.raises(ValueError, match=r"no checkpoint in .* can be used \(step 2: it cannot be"):
        restore(folder)
    assert names(folder) == ["1", "2"]


def test_another_base_is_no_damage(folder):
    with pytest.raises(ValueError, match="trained on another base: its hash is base"):
        restore(folder, "other")
    assert names(folder) == ["1", "2"]


def test_half_written_and_empty_folders_are_removed(folder):
    (folder / "checkpoints/2" / WRITTEN).unlink()
    (folder / "checkpoints/7").mkdir()
    step, said = restore(folder)
    assert (step, names(folder)) == (1, ["1"])
    for gone in (2, 7):
        assert f"the writer of the checkpoint at step {gone} was killed: it is removed" in said
    shutil.rmtree(folder / "checkpoints/1")
    assert restore(folder) == (None, "")


def test_a_full_disk_leaves_the_checkpoint_before(folder, caplog):
    """Files may not be as large as one of the state's."""
    checkpoints = Checkpoints(folder, "base", Console(file=io.StringIO()))
    message = r"could not be written \(File too large\), the one at step 2 stays: make room for"
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
    try:
        checkpoints.save(state(3))
        with pytest.raises(ValueError, match=message) as caught:
            checkpoints.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    assert "\n" not in str(caught.value)
    assert not [record for record in caplog.records if record.exc_info]
    assert names(folder) == ["1", "2"]
    assert restore(folder) == (2, "")


def test_threads_that_still_write_are_outlasted(folder, monkeypatch):
    """Of a failed write: a file more in a folder that is being removed."""
    (folder / "3" / "left").mkdir(parents=True)
    remove, failures = shutil.rmtree, [errno.ENOTEMPTY, errno.ENOENT]

    def rmtree(path):
        if failures:
            raise OSError(failures.pop(), "somebody else was there")
        remove(path)

    monkeypatch.setattr(shutil, "rmtree", rmtree)
    assert restore(folder)[0] == 2
    assert names(folder) == ["1", "2"]


@pytest.mark.parametrize("kind", ["float32", "bfloat16", "bool", "int8"])
def test_digest_sees_every_bit(kind):
    array = np.asarray(jax.random.normal(jax.random.key(0), (3, 5)) > 0.3).astype(jnp.dtype(kind))
    seen = {digest({"a": jnp.asarray(array)})}
    bits = 1 if kind == "bool" else 8 * array.dtype.itemsize
    for byte in range(0, array.nbytes, 7):
        for bit in range(min(bits, 8)):
            changed = bytearray(array.tobytes())
            changed[byte] ^= 1 << bit
            other = np.frombuffer(bytes(changed), array.dtype).reshape(array.shape)
            seen.add(digest({"a": jnp.asarray(other)}))
    assert len(seen) == 1 + len(range(0, array.nbytes, 7)) * min(bits, 8)


def test_digest_is_of_names_shapes_places_and_notes_too():
    a = jnp.arange(6.0)
    others = [
        digest({"a": a}),
        digest({"b": a}),
        digest({"a": a.reshape(2, 3)}),
        digest({"a": a[::-1]}),
        digest({"a": a.astype(jnp.bfloat16)}),
        digest({"a": a}, "note"),
        digest({"a": a, "b": a}),
    ]
    assert len(set(others)) == len(others)


def test_digest_does_not_depend_on_where_the_arrays_lie():
    array = jax.random.normal(jax.random.key(0), (16, 4, 6))
    expected = digest({"a": array})
    for mesh in (meshes.make_mesh(2), meshes.make_mesh(1, jax.devices()[:1])):
        for sharding in (meshes.batch_sharding(mesh), meshes.replicated(mesh)):
            assert digest({"a": jax.device_put(array, sharding)}) == expected


@pytest.mark.timeout(60)
def test_a_link_to_what_has_no_end_hangs_nobody(folder):
    file = next(path for path in (folder / "checkpoints" / "2").rglob("d/*") if path.is_file())
    file.unlink()
    file.symlink_to("/dev/zero")
    step, said = restore(folder)
    assert step == 1
    assert "the checkpoint at step 2 is damaged" in said
