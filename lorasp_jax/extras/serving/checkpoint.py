"""What a published checkpoint says of itself, what its training config says, and what is asked."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

from lorasp_jax.base import hub
from lorasp_jax.models.checkpoints import loading, openpi_configs
from lorasp_jax.models.config import VOCABULARY_SIZE, BackboneConfig
from lorasp_jax.policies.statistics import Statistics
from lorasp_jax.training.base import sized


@dataclass(frozen=True)
class Unsaid:
    """What the files of a published checkpoint may not say; it wins over what they say.

    Attributes:
        openpi_config: name of openpi's training config, see `openpi_configs`; "": that which the
            folder is named after.
        size: a size of π0, such as "base_pi05"; "": that of the files or of the training config.
        chunk: actions per chunk; 0: as with `size`.
        relative: indices of the actions that are relative to the state; None: as with `size`.
        prompt_state: whether π0.5's prompts contain the state; None: as with `size`.
        joints: J, where states have J+1 numbers; 0: as many as the training config or the
            statistics have.
        action_length: length of the actions; 0: the same.
    """

    openpi_config: str = ""
    size: str = ""
    chunk: int = 0
    relative: Sequence[int] | None = None
    prompt_state: bool | None = None
    joints: int = 0
    action_length: int = 0


@dataclass(frozen=True)
class Checkpoint:
    """A published checkpoint.

    Attributes:
        where: folder, Hub repository or bucket.
        found: its folder.
        given: what the user says of it.
        named: openpi's training config; None for checkpoints of others, and if it is not known.
    """

    where: str
    found: loading.ModelFolder
    given: Unsaid
    named: openpi_configs.OpenPiConfig | None

    @classmethod
    def find(cls, where: str, given: Unsaid) -> Self:
        """Find a checkpoint, and openpi's training config: the given one, or that of its name.

        Raises:
            ValueError: there is none, a name is unknown, or `given` lacks what nothing else says.
        """
        found = loading.find(hub.local(where))  # once: a hub could give another revision
        if not found.is_openpi:
            if given.openpi_config or given.size:
                raise ValueError(
                    f"--openpi-config and --size are for checkpoints of openpi, and {where} is none"
                )
            return cls(where, found, given, None)
        name = given.openpi_config
        named = openpi_configs.find(name) if name else openpi_configs.guess(where)
        if not named:
            _require(found, where, given)
        return cls(where, found, given, named)

    @cached_property
    def config(self) -> BackboneConfig:
        """The config of the model and of its inputs."""
        given = self.given
        config = sized("pi0", given.size) if given.size else None
        if self.named:
            config = self.named.apply(config) if config else self.named.config
        config = self.found.resized(config) if config else self.found.config
        inputs: dict[str, Any] = {}
        if given.relative is not None:
            size = max(given.relative, default=-1) + 1
            inputs["delta"] = tuple(i in given.relative for i in range(size))
        if given.prompt_state is not None:
            inputs["prompt_state"] = given.prompt_state
        inputs_config = dataclasses.replace(config.inputs, **inputs)
        return dataclasses.replace(config, inputs=inputs_config, chunk=given.chunk or config.chunk)

    @property
    def dataset(self) -> str:
        """The dataset whose statistics belong to the training config."""
        return self.named.robot.dataset if self.named else ""

    @property
    def cameras(self) -> dict[str, str]:
        """The backbone's cameras and the robot's names for them; empty: the same names."""
        return self.named.cameras(self.config) if self.named else self.found.robot_cameras

    @property
    def tokenizer(self) -> str:
        """Location of the tokenizer that belongs to the model; "": the bundled one.

        Raises:
            ValueError: the tokenizer is not known.
        """
        if self.config.vocabulary == VOCABULARY_SIZE:
            return ""
        if not self.found.is_openpi:
            raise ValueError(
                f"the files of {self.where} have no tokenizer: pass --tokenizer with that of its "
                f"language model, which has at most {self.config.vocabulary} tokens"
            )
        return openpi_configs.TOKENIZER

    def lengths(self, moments: Statistics) -> tuple[int, int]:
        """Return the number of joints and the length of actions.

        Raises:
            ValueError: only statistics could show them, and they are padded.
        """
        if self.named:
            state, length = self.named.robot.state_dim, self.named.robot.action_length
        else:
            measured, padded = (moments.dim, moments.action_length), self.config.action_dim
            state, length = (0 if n == padded else n for n in measured)
        state = self.given.joints + 1 if self.given.joints else state
        if not state:
            raise ValueError(
                f"the statistics of {self.where} do not show the robot's number of joints: pass "
                "--joints"
            )
        return state - 1, self.given.action_length or length or state


def _require(found: loading.ModelFolder, where: str, given: Unsaid) -> None:
    """Raise ValueError unless everything was given that openpi's files do not say.

    Its conversions to PyTorch record sizes and chunk.
    """
    config: Any = None
    if given.size:
        config = sized("pi0", given.size)
    elif found.records_lengths:
        config = found.config
    missing = {
        "--size": config is None,
        "--chunk": not given.chunk and not found.records_lengths,
        "--relative": given.relative is None,
        "--prompt-state": config is not None and config.pi05 and given.prompt_state is None,
    }
    if any(missing.values()):
        raise ValueError(
            f"the files of {where} do not say how its policy acts: pass --openpi-config with the "
            "name of its training config, such as pi05_libero, or else "
            f"{', '.join(name for name, lacks in missing.items() if lacks)}"
        )
