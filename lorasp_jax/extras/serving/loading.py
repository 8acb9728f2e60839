"""Load what a server serves: finished runs, or a published checkpoint with or without adapters."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lorasp_jax
from lorasp_jax.adapters.io import hugging_face
from lorasp_jax.base import hub
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.checkpoints import loading as checkpoints
from lorasp_jax.models.checkpoints import openpi_configs
from lorasp_jax.models.config import VOCABULARY_SIZE, BackboneConfig
from lorasp_jax.policies import statistics_files
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.statistics import Statistics
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
    dtype: str = "",
    cameras: Mapping[str, str] | None = None,
    adapters: Mapping[str, str] | None = None,
    **unsaid: Any,
) -> dict[str, Loaded]:
    """Load a published checkpoint, as `UNADAPTED` and with each of its adapters.

    Args:
        where: folder, Hub repository or bucket; see `models.load`.
        tokenizer: see `tokenizer.load_tokenizer`; "": the bundled one for models of its vocabulary,
            otherwise openpi's for its checkpoints.
        statistics: see `statistics_files.read`; "" searches the checkpoint.
        dataset: which statistics, if there are several.
        dtype: of parameters and products; "" leaves the default.
        cameras: backbone camera -> the robot's name for it; empty: as the training config or the
            files say, or the backbone's names.
        adapters: name -> folder of `save_adapters`, or LeRobot's of a PEFT adapter, which can also
            be a Hub repository.
        unsaid: fields of `Unsaid`.

    Raises:
        ValueError: something is missing or does not fit; see `models.load`, `statistics_files.read`
            and `Processor.of`.
    """
    folder, given = hub.local(where), Unsaid(**unsaid)  # once: a hub could give another revision
    found = checkpoints.find(folder)
    named = _named(found, where, given)
    config = _config(found, where, named, given)
    if dtype:
        config = dataclasses.replace(config, dtype=dtype, param_dtype=dtype)
    default = named.robot.dataset if named else ""
    moments = statistics_files.read(statistics or folder, dataset=dataset, default=default)
    joints, length = _lengths(where, moments, config, named, given)
    words = load_tokenizer(tokenizer or _tokenizer(found, where, config))
    prompt = named.prompt if named else ""
    # The instructions come with the requests; without a default, this one measures the table.
    prompts = PromptTable.of(words, [prompt or "press the button"], config, num_joints=joints)
    prompts = dataclasses.replace(prompts, instructions=(prompt,) if prompt else ())
    cameras = cameras or (named.cameras(config) if named else found.robot_cameras) or None
    processor = Processor.of(
        config, moments, prompts, num_joints=joints, action_length=length, cameras=cameras
    )
    model = found.load(config)
    models = {UNADAPTED: model}
    models |= {name: _adapted(path, model) for name, path in (adapters or {}).items()}
    metadata = {"reset_pose": [*named.reset_pose]} if named and named.reset_pose else {}
    return {
        name: Loaded(Policy(each, processor), words, metadata=metadata)
        for name, each in models.items()
    }


def _adapted(where: str, model: Backbone) -> Backbone:
    """Return the model with the adapters of a folder."""
    if hub.is_remote(where) or (Path(where) / hugging_face.CONFIG).exists():
        return lorasp_jax.load_peft(where, model, names=lorasp_jax.models.lerobot_names(model))
    return lorasp_jax.load_adapters(where, model)


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


def _named(
    found: checkpoints.ModelFolder, where: str, given: Unsaid
) -> openpi_configs.OpenPiConfig | None:
    """Return openpi's training config of a checkpoint: the given one, or that of its name."""
    if not found.is_openpi:
        if given.openpi_config or given.size:
            raise ValueError(
                f"--openpi-config and --size are for checkpoints of openpi, and {where} is none"
            )
        return None
    name = given.openpi_config
    return openpi_configs.find(name) if name else openpi_configs.guess(where)


def _config(
    found: checkpoints.ModelFolder,
    where: str,
    named: openpi_configs.OpenPiConfig | None,
    given: Unsaid,
) -> BackboneConfig:
    """Return the config of the checkpoint's model and inputs."""
    if found.is_openpi and not named:
        _require(where, given, found.fields)
    config = found.resized(sized("pi0", given.size)) if given.size else None
    if named:
        config = named.apply(config) if config else named.config
    config = config or found.config
    inputs: dict[str, Any] = {}
    if given.relative is not None:
        size = max(given.relative, default=-1) + 1
        inputs["delta"] = tuple(i in given.relative for i in range(size))
    if given.prompt_state is not None:
        inputs["prompt_state"] = given.prompt_state
    inputs_config = dataclasses.replace(config.inputs, **inputs)
    return dataclasses.replace(config, inputs=inputs_config, chunk=given.chunk or config.chunk)


def _require(where: str, given: Unsaid, fields: Mapping[str, Any]) -> None:
    """Raise ValueError unless everything was given that openpi's files do not say."""
    missing = {
        "--size": not given.size and checkpoints.HORIZON not in fields,
        "--chunk": not given.chunk and checkpoints.HORIZON not in fields,
        "--relative": given.relative is None,
        "--prompt-state": "pi05" in given.size and given.prompt_state is None,
    }
    if any(missing.values()):
        raise ValueError(
            f"the files of {where} do not say how its policy acts: pass --openpi-config with the "
            "name of its training config, such as pi05_libero, or else "
            f"{', '.join(name for name, lacks in missing.items() if lacks)}"
        )


def _tokenizer(found: checkpoints.ModelFolder, where: str, config: BackboneConfig) -> str:
    """Return the location of the tokenizer that belongs to the model; "": the bundled one."""
    if config.vocabulary == VOCABULARY_SIZE:
        return ""
    if not found.is_openpi:
        raise ValueError(
            f"the files of {where} have no tokenizer: pass --tokenizer with that of its language "
            f"model, which has at most {config.vocabulary} tokens"
        )
    return openpi_configs.TOKENIZER


def _lengths(
    where: str,
    moments: Statistics,
    config: BackboneConfig,
    named: openpi_configs.OpenPiConfig | None,
    given: Unsaid,
) -> tuple[int, int]:
    """Return the number of joints and the length of actions; padded statistics do not show them."""
    padded, measured = config.action_dim, (moments.dim, moments.action_length)
    measured = [0 if length == padded else length for length in measured]
    state, length = (named.robot.state_dim, named.robot.action_length) if named else measured
    state = given.joints + 1 if given.joints else state
    if not state:
        raise ValueError(
            f"the statistics of {where} do not show the robot's number of joints: pass --joints"
        )
    return state - 1, given.action_length or length or state
