"""Corrupt checkpoints, incomplete ones and full disks: restored exactly or rejected."""

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

from lorasp_jax.base.digest import digest
from lorasp_jax.training.checkpoint import COMMIT_MARKER, Checkpoints
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.guard import Guard
from lorasp_jax.training.step import TrainState
from tests.runs import leaves

# If a read fails, Orbax leaves others behind that are never awaited.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
LARGE = (100, 80)  # too large for Orbax to store inline with its metadata


def state(step):
    key = jax.random.key(step)
    adapters = {"a": jax.random.normal(key, LARGE), "b": step * jnp.ones(3, jnp.bfloat16)}
    return TrainState(jnp.int32(step), adapters, {"mu": jnp.zeros(LARGE)}, Guard.initial())


@pytest.fixture(autouse=True)
def collect_unawaited_reads():
    """Trigger their warnings here, when they are garbage-collected."""
    yield
    gc.collect()


@pytest.fixture(scope="module")
def master(tmp_path_factory):
    """A folder with checkpoints of steps 1 and 2."""
    folder = tmp_path_factory.mktemp("master")
    checkpoints = Checkpoints(folder, "base", Console(file=io.StringIO()))
    for step in (1, 2):
        checkpoints.save(state(step))
    checkpoints.close()
    return folder


@pytest.fixture
def folder(master, tmp_path):
    """A copy that a test may corrupt."""
    return shutil.copytree(master, tmp_path / "run")


def restore(folder, base_hash="base"):
    """Restore and check the state; return its step and the printed warnings."""
    console = Console(file=io.StringIO(), width=1000)
    checkpoints = Checkpoints(folder, base_hash, console)
    try:
        restored = checkpoints.restore(state(0))
    finally:
        checkpoints.close()
    if restored is None:
        return None, console.file.getvalue()
    for name, value in leaves(state(int(restored.step))).items():
        np.testing.assert_array_equal(leaves(restored)[name], value, err_msg=name)
    return int(restored.step), console.file.getvalue()


def names(folder):
    return sorted(path.name for path in (folder / "checkpoints").iterdir())


def files(folder):
    found = sorted((folder / "checkpoints" / "2").rglob("*"))
    return [path.relative_to(folder) for path in found if path.is_file()]


def flipped(content, position):
    return content[:position] + bytes([content[position] ^ 0x10]) + content[position + 1 :]


def sweep(master, tmp_path, damages):
    """Count by step how often the corrupted checkpoint and the previous one were restored."""
    counts = {1: 0, 2: 0}
    for file in files(master):
        content = (master / file).read_bytes()
        for damaged in damages(content):
            folder = shutil.copytree(master, tmp_path / "run")
            (folder / file).write_bytes(damaged)
            step, printed = restore(folder)
            counts[step] += 1
            if step == 2:
                assert (printed, names(folder)) == ("", ["1", "2"]), file
            else:
                assert "the checkpoint at step 2 is corrupt (" in printed, file
                assert printed.endswith("2.damaged, resuming from step 1\n"), file
                assert names(folder) == ["1", "2.damaged"], file
            shutil.rmtree(folder)
    return counts


def test_a_corrupt_file_is_never_restored_with_other_values(master, tmp_path):
    def damages(content):
        return flipped(content, len(content) // 2), content[: len(content) // 2]

    steps = sweep(master, tmp_path, damages)
    assert steps[1] >= 10
    assert steps[2] >= 10  # Orbax does not need every file


@pytest.mark.slow
def test_corruption_at_many_positions(master, tmp_path):
    def damages(content):
        size, every = len(content), max(len(content) // 25, 1)
        yield from (flipped(content, position) for position in range(0, size, every))
        yield from (content[:cut] for cut in (0, 1, size // 3, size - 1))

    steps = sweep(master, tmp_path, damages)
    assert sum(steps.values()) > 400
    assert min(steps.values()) > 100


def test_repeatedly_corrupt_checkpoints_are_all_kept(folder):
    for expected in (["1", "2.damaged"], ["1", "2.damaged", "2.damaged.1"]):
        (folder / "checkpoints/2/meta/metadata").write_text("{}")
        assert restore(folder)[0] == 1
        assert names(folder) == expected
        checkpoints = Checkpoints(folder, "base", Console(file=io.StringIO()))
        checkpoints.save(state(2))  # as the resumed run does
        checkpoints.close()
        assert restore(folder) == (2, "")


def test_nothing_changes_if_all_checkpoints_are_corrupt(folder):
    for step in (1, 2):
        (folder / f"checkpoints/{step}/meta/metadata").write_text("{}")
    with pytest.raises(ValueError, match=r"all checkpoints in .* are corrupt \(step 2: unreadable"):
        restore(folder)
    assert names(folder) == ["1", "2"]


def test_another_base_is_not_corruption(folder):
    with pytest.raises(ValueError, match=r"trained on a different base \(hash base"):
        restore(folder, "other")
    assert names(folder) == ["1", "2"]


def test_incomplete_checkpoints_are_removed(folder):
    (folder / "checkpoints/2" / COMMIT_MARKER).unlink()
    (folder / "checkpoints/7").mkdir()
    step, printed = restore(folder)
    assert (step, names(folder)) == (1, ["1"])
    for removed in (2, 7):
        assert f"removed the incomplete checkpoint at step {removed}: saving" in printed
    shutil.rmtree(folder / "checkpoints/1")
    assert restore(folder) == (None, "")


def test_a_full_disk_leaves_the_previous_checkpoint(folder, caplog):
    """The file size limit is below the size of an array."""
    checkpoints = Checkpoints(folder, "base", Console(file=io.StringIO()))
    message = r"could not be written \(File too large\); the one at step 2 is complete: free some"
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


def test_removal_retries_while_other_threads_still_write(folder, monkeypatch):
    """After a failed write they may add a file to a folder that is being removed."""
    (folder / "3" / "left").mkdir(parents=True)
    remove, failures = shutil.rmtree, [errno.ENOTEMPTY, errno.ENOENT]

    def rmtree(path):
        if failures:
            raise OSError(failures.pop(), "another thread wrote here")
        remove(path)

    monkeypatch.setattr(shutil, "rmtree", rmtree)
    assert restore(folder)[0] == 2
    assert names(folder) == ["1", "2"]


@pytest.mark.parametrize("kind", ["float32", "bfloat16", "bool", "int8"])
def test_the_digest_depends_on_every_bit(kind):
    array = np.asarray(jax.random.normal(jax.random.key(0), (3, 5)) > 0.3).astype(jnp.dtype(kind))
    digests = {digest({"a": jnp.asarray(array)})}
    bits = 1 if kind == "bool" else 8 * array.dtype.itemsize
    for byte in range(0, array.nbytes, 7):
        for bit in range(min(bits, 8)):
            changed = bytearray(array.tobytes())
            changed[byte] ^= 1 << bit
            other = np.frombuffer(bytes(changed), array.dtype).reshape(array.shape)
            digests.add(digest({"a": jnp.asarray(other)}))
    assert len(digests) == 1 + len(range(0, array.nbytes, 7)) * min(bits, 8)


def test_the_digest_depends_on_names_shapes_order_dtypes_and_notes():
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


def test_the_digest_does_not_depend_on_sharding():
    array = jax.random.normal(jax.random.key(0), (16, 4, 6))
    expected = digest({"a": array})
    for mesh in (meshes.make_mesh(2), meshes.make_mesh(1, jax.devices()[:1])):
        for sharding in (meshes.batch_sharding(mesh), meshes.replicated(mesh)):
            assert digest({"a": jax.device_put(array, sharding)}) == expected


@pytest.mark.timeout(60)
def test_a_link_to_an_endless_device_does_not_hang(folder):
    file = next(path for path in (folder / "checkpoints" / "2").rglob("d/*") if path.is_file())
    file.unlink()
    file.symlink_to("/dev/zero")
    step, printed = restore(folder)
    assert step == 1
    assert "the checkpoint at step 2 is corrupt" in printed
