"""Checkpoints: adapters, optimizer state and step, by Orbax; the frozen base stays where it is.

The data position and every random stream of a run are functions of its seed and the step number, so
these three restore a run to the bit. The base is recorded by its hash.
"""

from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from lorasp_jax.training.step import TrainState


class Checkpoints:
    """The checkpoints of one run folder, at most two, written in the background."""

    def __init__(self, folder: Path, base_hash: str) -> None:
        """Open `folder`/checkpoints for a run on the base identified by `base_hash`."""
        atomic = ocp.options.AtomicityOptions(mode=ocp.options.AtomicityMode.COMMIT_FILE)
        options = ocp.CheckpointManagerOptions(max_to_keep=2, atomicity_options=atomic)
        self._manager = ocp.CheckpointManager((folder / "checkpoints").absolute(), options=options)
        self._base_hash = base_hash

    def save(self, state: TrainState) -> None:
        """Start writing `state`; returns before it is on disk."""
        step = int(state.step)
        if self._manager.latest_step() == step:
            return
        self._manager.save(
            step,
            args=ocp.args.Composite(
                state=ocp.args.StandardSave(_by_path(state)),
                meta=ocp.args.JsonSave({"base_hash": self._base_hash}),
            ),
        )

    def restore(self, like: TrainState) -> TrainState | None:
        """The newest state with the structure, types and shardings of `like`; None without one.

        Raises:
            ValueError: the checkpoint is damaged, or was made on another base.
        """
        step = self._manager.latest_step()
        if step is None:
            return None
        abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, _by_path(like))
        try:
            found = self._manager.restore(
                step,
                args=ocp.args.Composite(
                    state=ocp.args.StandardRestore(abstract), meta=ocp.args.JsonRestore()
                ),
            )
        except Exception as error:  # Orbax raises whatever its storage raises
            raise ValueError(
                f"the checkpoint at step {step} in {self._manager.directory} cannot be read: "
                "remove its folder to resume from the one before"
            ) from error
        base_hash = found["meta"]["base_hash"]
        if base_hash != self._base_hash:
            raise ValueError(
                f"the checkpoint at step {step} was trained on another base: its hash is "
                f"{base_hash[:12]}, this base's is {self._base_hash[:12]}"
            )
        names = [jax.tree_util.keystr(p) for p, _ in jax.tree_util.tree_leaves_with_path(like)]
        return jax.tree.unflatten(jax.tree.structure(like), [found["state"][n] for n in names])

    def close(self) -> None:
        """Wait until everything is on disk."""
        self._manager.wait_until_finished()
        self._manager.close()


def _by_path(tree: Any) -> dict[str, jax.Array]:
    """A flat dictionary from tree path to leaf: one file layout, whatever the containers are."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
