"""Load what a server serves: finished runs, or a published checkpoint with or without adapters."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lorasp_jax
from lorasp_jax.adapters.io import hugging_face
from lorasp_jax.base import hub
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.checkpoints import loading
from lorasp_jax.policies import statistics_files
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.tokenizer import Tokenizer, load_tokenizer
from lorasp_jax.training import export
from lorasp_jax.training.base import sized
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


def load_run(folder: str, *, base: str = "", words: str = "") -> Loaded:
    """Load a finished run; arguments and errors are those of `load_policy`."""
    described = export.describe(folder)
    policy = export.load_policy(folder, base=base, words=words)
    recorded = hub.resolve_portable(described["policy"]["tokenizer"])
    config = read_json(Path(folder) / CONFIG_FILE, {"optim": {}})
    return Loaded(
        policy,
        load_tokenizer(words or recorded),
        continues=bool(config["optim"].get("rtc_max_delay")) if config else None,
        metadata={key: described.get(key) for key in ("robot", "control_dt")},
    )


def load_checkpoint(
    where: str,
    *,
    tokenizer: str = "",
    statistics: str = "",
    dataset: str = "",
    joints: int = 0,
    size: str = "",
    dtype: str = "",
    cameras: Mapping[str, str] | None = None,
    adapters: Mapping[str, str] | None = None,
) -> dict[str, Loaded]:
    """Load a published checkpoint, as `UNADAPTED` and with each of its adapters.

    Args:
        where: folder, Hub repository or bucket; see `models.load`.
        tokenizer: see `tokenizer.load_tokenizer`.
        statistics: see `statistics_files.read`; "" searches the checkpoint.
        dataset: which statistics, if there are several.
        joints: J; 0: the statistics' dimensions but one.
        size: a size of π0, such as "base_pi05", for checkpoints that do not record it.
        dtype: of parameters and products; "" leaves the default.
        cameras: backbone camera -> the robot's name for it; empty: the backbone's names.
        adapters: name -> folder of `save_adapters`, or LeRobot's of a PEFT adapter, which can also
            be a Hub repository.

    Raises:
        ValueError: something is missing or does not fit; see `models.load`, `statistics_files.read`
            and `Processor.of`.
    """
    checkpoint = loading.find(where)
    folder = checkpoint.folder  # asking a hub again could give another revision
    config = checkpoint.resized(sized("pi0", size)) if size else checkpoint.config
    if dtype:
        config = dataclasses.replace(config, dtype=dtype, param_dtype=dtype)
    moments = statistics_files.read(statistics or folder, dataset=dataset)
    if not joints and moments.dim == config.action_dim:
        raise ValueError(
            f"the statistics of {where} do not show the robot's number of joints: pass --joints"
        )
    joints, words = joints or moments.dim - 1, load_tokenizer(tokenizer)
    # The instructions come with the requests; these only measure the table.
    prompts = PromptTable.of(words, ["press the button"], config, num_joints=joints)
    prompts = dataclasses.replace(prompts, instructions=())
    processor = Processor.of(config, moments, prompts, num_joints=joints, cameras=cameras or None)
    model = checkpoint.load(config)
    models = {UNADAPTED: model}
    models |= {name: _adapted(path, model) for name, path in (adapters or {}).items()}
    return {name: Loaded(Policy(each, processor), words) for name, each in models.items()}


def _adapted(where: str, model: Backbone) -> Backbone:
    """Return the model with the adapters of a folder."""
    if hub.is_remote(where) or (Path(where) / hugging_face.CONFIG).exists():
        return lorasp_jax.load_peft(where, model, names=lorasp_jax.models.lerobot_names(model))
    return lorasp_jax.load_adapters(where, model)
