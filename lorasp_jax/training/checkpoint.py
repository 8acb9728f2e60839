"""Orbax checkpoints of adapters, optimizer state and step; the frozen base is not saved.

The data position and every random stream depend only on the seed and the step, so a resumed run is
bit-identical to an uninterrupted one. The hash of the base and a digest of the saved values are
stored as well.
"""

import contextlib
import errno
import itertools
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import jax
import orbax.checkpoint as ocp
from rich.console import Console

from lorasp_jax.base.digest import digest
from lorasp_jax.base.errors import DISK_FULL
from lorasp_jax.base.writing import rename
from lorasp_jax.models.checkpoints import orbax_folders
from lorasp_jax.training.distributed import processes

State = TypeVar("State")

COMMIT_MARKER = "commit_success.txt"
"""File that Orbax writes into a checkpoint's folder once the checkpoint is complete."""


class Checkpoints:
    """Asynchronous checkpoints of one run; the newest two are kept."""

    def __init__(self, folder: Path, base_hash: str, console: Console) -> None:
        """Open `folder`/checkpoints for a run on the base with this hash."""
        orbax_folders.suppress_repeated_errors()
        atomic = ocp.options.AtomicityOptions(mode=ocp.options.AtomicityMode.COMMIT_FILE)
        options = ocp.CheckpointManagerOptions(max_to_keep=2, atomicity_options=atomic)
        self._folder = (folder / "checkpoints").absolute()
        self._manager = ocp.CheckpointManager(self._folder, options=options)
        self._base_hash, self._console = base_hash, console

    @property
    def has_any(self) -> bool:
        """Whether there is a complete checkpoint; it may be corrupt."""
        return bool(self._manager.all_steps())

    def save(self, state: Any) -> None:
        """Save a state with a `step` `[]`, such as a `TrainState`, asynchronously.

        Raises:
            ValueError: this or the previous checkpoint could not be written.
        """
        step, leaves = int(state.step), by_path(state)
        if self._manager.latest_step() == step:
            return
        meta = {"base_hash": self._base_hash, "digest": digest(leaves, self._base_hash)}
        with self._writing():
            self._manager.save(
                step,
                args=ocp.args.Composite(
                    state=ocp.args.StandardSave(leaves), meta=ocp.args.JsonSave(meta)
                ),
            )

    def restore(self, like: State) -> State | None:
        """Restore the newest intact checkpoint; return None if there are no checkpoints.

        Newer corrupt checkpoints are renamed and incomplete ones removed, with a warning for each.
        `like` has the structure, dtypes and shardings of the result; shapes will do.

        Raises:
            ValueError: all checkpoints are corrupt, or one belongs to a different base.
        """
        for step in self._remove_incomplete():
            self._warn(f"removed the incomplete checkpoint at step {step}: saving was interrupted")
        processes.barrier("removed")
        corrupt: dict[int, str] = {}
        for step in sorted(self._manager.all_steps(), reverse=True):
            leaves, reason = {}, ""
            try:
                leaves = self._read(step, by_path(like))
            except _CorruptError as error:
                reason = str(error)
            if processes.any_process(bool(reason)):
                corrupt[step] = reason or "unreadable in another process"
                continue
            if corrupt:
                self._rename_corrupt(corrupt, step)
            return jax.tree.unflatten(jax.tree.structure(like), [leaves[n] for n in by_path(like)])
        if corrupt:
            reasons = "; ".join(f"step {step}: {reason}" for step, reason in corrupt.items())
            raise ValueError(
                f"all checkpoints in {self._folder} are corrupt ({reasons}): delete that folder to "
                "restart from step 0"
            )
        return None

    def close(self) -> None:
        """Wait until all checkpoints are on disk.

        Raises:
            ValueError: the last checkpoint could not be written.
        """
        try:
            with self._writing():
                self._manager.wait_until_finished()
        finally:
            self._manager.close()

    def _read(self, step: int, like: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """Read the leaves saved at a step and verify them."""
        arguments = ocp.args.Composite(
            state=ocp.args.StandardRestore(jax.tree.map(ocp.utils.to_shape_dtype_struct, like)),
            meta=ocp.args.JsonRestore(),
        )
        try:
            orbax_folders.check(self._folder / str(step))
            checkpoint = self._manager.restore(step, args=arguments)
            base_hash, expected = (checkpoint["meta"][name] for name in ("base_hash", "digest"))
        except Exception as error:  # Orbax lets any storage error through
            raise _CorruptError("unreadable") from error
        if digest(checkpoint["state"], str(base_hash)) != expected:
            raise _CorruptError("digest mismatch")
        if base_hash != self._base_hash:
            raise ValueError(
                f"the checkpoint at step {step} was trained on a different base (hash "
                f"{base_hash[:12]}, but this base has {self._base_hash[:12]})"
            )
        return checkpoint["state"]

    def _rename_corrupt(self, corrupt: dict[int, str], resume_step: int) -> None:
        for step, reason in corrupt.items():
            names = itertools.chain([""], (f".{number}" for number in itertools.count(1)))
            paths = (self._folder / f"{step}.damaged{name}" for name in names)
            renamed = next(path for path in paths if not path.exists())
            if processes.is_first():
                rename(self._folder / str(step), renamed)
            self._warn(
                f"the checkpoint at step {step} is corrupt ({reason}): renamed to {renamed}, "
                f"resuming from step {resume_step}"
            )
        processes.barrier("renamed")
        self._manager.reload()

    def _steps(self) -> dict[int, bool]:
        """Return the saved steps and whether each checkpoint is complete."""
        paths = [path for path in self._folder.iterdir() if path.name.isdecimal()]
        return {int(path.name): (path / COMMIT_MARKER).exists() for path in paths}

    def _remove_incomplete(self) -> list[int]:
        """Remove incomplete checkpoints and return their steps."""
        incomplete = sorted(step for step, complete in self._steps().items() if not complete)
        for step in incomplete if processes.is_first() else ():
            path = self._folder / str(step)
            while path.exists():
                try:
                    shutil.rmtree(path)
                except OSError as error:
                    # After a failed write, Orbax threads may still create and delete files.
                    if error.errno not in (errno.ENOTEMPTY, errno.ENOENT):
                        raise
        return incomplete

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Convert an Orbax error about a failed write to a one-line ValueError."""
        try:
            yield
        except Exception as error:  # Orbax lets any storage error through
            self._remove_incomplete()
            full = [text for text in map(os.strerror, DISK_FULL) if text in str(error)]
            reason = full[0] if full else str(error).partition("\n")[0][:200]
            steps = self._steps()
            remaining = f"the one at step {max(steps)} is complete" if steps else "no other exists"
            hint = "free some disk space and add --resume" if full else "add --resume"
            raise ValueError(
                f"a checkpoint could not be written ({reason}); {remaining}: {hint}"
            ) from error

    def _warn(self, text: str) -> None:
        self._console.print(f"warning: {text}", style="bold yellow", markup=False, soft_wrap=True)


class _CorruptError(Exception):
    """A checkpoint is corrupt; the message states the symptom."""


def by_path(tree: Any) -> dict[str, jax.Array]:
    """Flatten a tree to a dict from path to leaf, so that files do not depend on node types."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
