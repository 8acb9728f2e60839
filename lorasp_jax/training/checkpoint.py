"""Checkpoints: adapters, optimizer state and step, by Orbax; the frozen base stays where it is.

The data position and every random stream of a run are functions of its seed and the step number, so
these three restore a run to the bit. The base is recorded by its hash, the values by their digest.
"""

import contextlib
import errno
import itertools
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp
from rich.console import Console

from envs.cli.errors import DISK_FULL
from envs.datasets.writing import rename
from lorasp_jax.models.checkpoints import orbax_folders
from lorasp_jax.storage.digest import digest
from lorasp_jax.training.distributed import processes
from lorasp_jax.training.step import TrainState

WRITTEN = "commit_success.txt"
"""What Orbax puts into the folder of a checkpoint when all of it is on disk."""


class Checkpoints:
    """The checkpoints of one run folder, at most two, written in the background."""

    def __init__(self, folder: Path, base_hash: str, console: Console) -> None:
        """Open `folder`/checkpoints for a run on the base identified by `base_hash`."""
        orbax_folders.suppress_repeated_errors()
        atomic = ocp.options.AtomicityOptions(mode=ocp.options.AtomicityMode.COMMIT_FILE)
        options = ocp.CheckpointManagerOptions(max_to_keep=2, atomicity_options=atomic)
        self._folder = (folder / "checkpoints").absolute()
        self._manager = ocp.CheckpointManager(self._folder, options=options)
        self._base_hash, self._console = base_hash, console

    def save(self, state: TrainState) -> None:
        """Start writing `state`; returns before it is on disk.

        Raises:
            ValueError: this one, or the one before, could not be written.
        """
        step, leaves = int(state.step), _by_path(state)
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

    def restore(self, like: TrainState) -> TrainState | None:
        """The newest whole state, with structure, types and shardings of `like`; None without one.

        Damaged checkpoints that are newer are set aside, and those whose writer was killed are
        removed; both is said.

        Raises:
            ValueError: all checkpoints are damaged, or one was made on another base.
        """
        for step in self._remove_unfinished():
            self._say(f"the writer of the checkpoint at step {step} was killed: it is removed")
        processes.barrier("removed")
        damaged: dict[int, str] = {}
        for step in sorted(self._manager.all_steps(), reverse=True):
            leaves, reason = {}, ""
            try:
                leaves = self._read(step, _by_path(like))
            except _DamagedError as error:
                reason = str(error)
            if processes.any_process(bool(reason)):
                damaged[step] = reason or "another process cannot read it"
                continue
            if damaged:
                self._set_aside(damaged, step)
            names = [jax.tree_util.keystr(p) for p, _ in jax.tree_util.tree_leaves_with_path(like)]
            return jax.tree.unflatten(jax.tree.structure(like), [leaves[n] for n in names])
        if damaged:
            found = "; ".join(f"step {step}: {reason}" for step, reason in damaged.items())
            raise ValueError(
                f"no checkpoint in {self._folder} can be used ({found}): remove that folder to "
                "resume from the very beginning"
            )
        return None

    def close(self) -> None:
        """Wait until everything is on disk.

        Raises:
            ValueError: the last checkpoint could not be written.
        """
        try:
            with self._writing():
                self._manager.wait_until_finished()
        finally:
            self._manager.close()

    def _read(self, step: int, like: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """The leaves at a step, which are those that were saved."""
        arguments = ocp.args.Composite(
            state=ocp.args.StandardRestore(jax.tree.map(ocp.utils.to_shape_dtype_struct, like)),
            meta=ocp.args.JsonRestore(),
        )
        try:
            orbax_folders.check(self._folder / str(step))
            found = self._manager.restore(step, args=arguments)
            base_hash, expected = (found["meta"][name] for name in ("base_hash", "digest"))
        except Exception as error:  # Orbax raises whatever its storage raises
            raise _DamagedError("it cannot be read") from error
        if digest(found["state"], str(base_hash)) != expected:
            raise _DamagedError("its values are not those that were saved")
        if base_hash != self._base_hash:
            raise ValueError(
                f"the checkpoint at step {step} was trained on another base: its hash is "
                f"{base_hash[:12]}, this base's is {self._base_hash[:12]}"
            )
        return found["state"]

    def _set_aside(self, damaged: dict[int, str], used: int) -> None:
        """Rename damaged checkpoints, and say so."""
        for step, reason in damaged.items():
            names = (self._folder / f"{step}.damaged{suffix}" for suffix in _suffixes())
            aside = next(path for path in names if not path.exists())
            if processes.is_first():
                rename(self._folder / str(step), aside)
            self._say(
                f"the checkpoint at step {step} is damaged, {reason}: it is set aside as {aside}, "
                f"and the run goes on from step {used}"
            )
        processes.barrier("set aside")
        self._manager.reload()

    def _steps(self) -> dict[int, bool]:
        """Steps whose folders there are, and whether they were written to their end."""
        paths = [path for path in self._folder.iterdir() if path.name.isdecimal()]
        return {int(path.name): (path / WRITTEN).exists() for path in paths}

    def _remove_unfinished(self) -> list[int]:
        """Remove checkpoints that were not written to their end; their steps."""
        unfinished = sorted(step for step, whole in self._steps().items() if not whole)
        for step in unfinished if processes.is_first() else ():
            path = self._folder / str(step)
            while path.exists():
                try:
                    shutil.rmtree(path)
                except OSError as error:
                    # After a failed write Orbax' threads still add and remove files of their own.
                    if error.errno not in (errno.ENOTEMPTY, errno.ENOENT):
                        raise
        return unfinished

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Turn what Orbax raises about a failed write into one sentence."""
        try:
            yield
        except Exception as error:  # Orbax raises whatever its storage raises
            self._remove_unfinished()
            full = [text for text in map(os.strerror, DISK_FULL) if text in str(error)]
            reason = full[0] if full else str(error).partition("\n")[0][:200]
            stays = (
                f"the one at step {max(kept)} stays" if (kept := self._steps()) else "none is left"
            )
            hint = "make room for the run's folder and add --resume" if full else "add --resume"
            raise ValueError(
                f"a checkpoint could not be written ({reason}), {stays}: {hint}"
            ) from error

    def _say(self, text: str) -> None:
        """Print a warning."""
        self._console.print(f"warning: {text}", style="bold yellow", markup=False, soft_wrap=True)


class _DamagedError(Exception):
    """A checkpoint is not what was saved; the message says how that shows."""


def _suffixes() -> Iterator[str]:
    """ "", ".1", ".2", ..."""
    return itertools.chain([""], (f".{number}" for number in itertools.count(1)))


def _by_path(tree: Any) -> dict[str, jax.Array]:
    """A flat dictionary from tree path to leaf: one file layout, whatever the containers are."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
