"""Load what a server serves: finished runs, or a published checkpoint with or without adapters."""

import dataclasses
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lorasp_jax.adapters.io import native
from lorasp_jax.base import hub
from lorasp_jax.models import backbone
from lorasp_jax.models.checkpoints import loading
from lorasp_jax.policies import statistics_files, tokenizer
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.tokenizer import Tokenizer
from lorasp_jax.training import export
from lorasp_jax.training.base import SIZES
from lorasp_jax.training.run_folder import CONFIG_FILE, read_json

UNADAPTED = "base"
"""Name of a checkpoint without adapters, for requests that choose among several."""


@dataclass(frozen=True)
class Loaded:
    """A policy that was loaded.

    Attributes:
        policy: the policy.
        words: its tokenizer.
        continues: whether it was trained to continue chunks; None: its files do not say.
        metadata: what they say of its robot.
    """

    policy: Policy
    words: Tokenizer
    continues: bool | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Checkpoint:
    """A published checkpoint, and what its files do not say.

    Attributes:
        where: folder, Hub repository or bucket; see `models.load`.
        tokenizer: see `tokenizer.load_tokenizer`.
        statistics: see `statistics_files.read`; "" searches the checkpoint.
        dataset: which statistics, if there are several.
        joints: J; 0: the statistics' dimensions but one.
        size: a size of π0, such as "base_pi05", for checkpoints that do not record it.
        dtype: of parameters and products; "" leaves the default.
        cameras: backbone camera -> the robot's name for it; empty: the backbone's names.
        adapters: name -> folder; see `load_adapters`.
    """

    where: str
    tokenizer: str = ""
    statistics: str = ""
    dataset: str = ""
    joints: int = 0
    size: str = ""
    dtype: str = ""
    cameras: Mapping[str, str] = field(default_factory=dict)
    adapters: Mapping[str, str] = field(default_factory=dict)


def is_run(where: str | os.PathLike[str]) -> bool:
    """Return whether `where` is the folder of a run, as opposed to a checkpoint."""
    path = Path(where)
    return (path / native.DESCRIPTION).is_file() or (path / export.BASE).is_dir()


def load_run(folder: str, *, base: str = "", words: str = "") -> Loaded:
    """Load a finished run; arguments and errors are those of `load_policy`."""
    described = export.describe(folder)
    policy = export.load_policy(folder, base=base, words=words)
    recorded = hub.resolve_portable(described["policy"]["tokenizer"])
    config = read_json(Path(folder) / CONFIG_FILE, {"optim": {}})
    return Loaded(
        policy,
        tokenizer.load_tokenizer(words or recorded),
        continues=bool(config["optim"].get("rtc_max_delay")) if config else None,
        metadata={key: described.get(key) for key in ("robot", "control_dt")},
    )


def load_checkpoint(checkpoint: Checkpoint) -> dict[str, Loaded]:
    """Load a published checkpoint, as `UNADAPTED` and with each of its adapters.

    Raises:
        ValueError: something is missing or does not fit; see `models.load`, `statistics_files.read`
            and `Processor.of`.
    """
    found = loading.find(checkpoint.where)
    config = found.config
    if checkpoint.size:
        config = _config(checkpoint.size)
    if checkpoint.dtype:
        dtypes = {"dtype": checkpoint.dtype, "param_dtype": checkpoint.dtype}
        config = dataclasses.replace(config, **dtypes)
    statistics = statistics_files.read(
        checkpoint.statistics or found.folder, dataset=checkpoint.dataset
    )
    if not checkpoint.joints and statistics.dim == config.action_dim:
        raise ValueError(
            f"the statistics of {checkpoint.where} do not show the robot's number of joints: pass "
            "--joints"
        )
    joints = checkpoint.joints or statistics.dim - 1
    words = tokenizer.load_tokenizer(checkpoint.tokenizer)
    # The instructions come with the requests; these only measure the table.
    prompts = PromptTable.of(words, ["press the button"], config, num_joints=joints)
    processor = Processor.of(
        config,
        statistics,
        dataclasses.replace(prompts, instructions=()),
        num_joints=joints,
        cameras=checkpoint.cameras or None,
    )
    model = found.load(config)
    models = {UNADAPTED: model}
    models |= {n: native.load_adapters(f, model) for n, f in checkpoint.adapters.items()}
    return {name: Loaded(Policy(adapted, processor), words) for name, adapted in models.items()}


def _config(size: str) -> Any:
    pi0 = backbone.find("pi0")
    if not hasattr(pi0, size) or size not in SIZES:
        known = ", ".join(name for name in SIZES if hasattr(pi0, name))
        raise ValueError(f"unknown size {size!r}: choose one of {known}")
    return getattr(pi0, size)()
