"""Export the trained policy of a run, as adapters or as a full base, and load it again."""

import dataclasses
import functools
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from envs.datasets.episodes import joint_names
from lorasp_jax import models
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.compress.quantization import Kind
from lorasp_jax.adapters.io import native
from lorasp_jax.base import hub
from lorasp_jax.base.digest import digest
from lorasp_jax.data.source import dimension_names
from lorasp_jax.models import backbone, noise_actor
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.noise_actor import NoiseActor
from lorasp_jax.models.sampling import NUM_STEPS
from lorasp_jax.policies import tokenizer
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.statistics import Statistics
from lorasp_jax.training import rules
from lorasp_jax.training.base import TRAINING, on_host, quantized
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import CONFIG_FILE, read_json, write_json

BASE = "base"
"""Folder of a fully fine-tuned base."""
QUANTIZED = "quantized"
"""Key of the kind of a base that is quantized after loading."""
STEPS = "denoise_steps"
"""Key of the flow steps of a run, in its config and in the files of its variants."""
DIMENSIONS = ("names", "units")
"""Keys of the names and units of a run's states and actions, as far as they are known."""


class Export(Callback):
    """Exports the trained policy after the last step (see `write`)."""

    def on_end(self, run: Run) -> None:
        """Write the trained policy."""
        write(run)


def write(run: Run) -> None:
    """Write adapter.safetensors and adapter.json, or the folder `base` after full fine-tuning.

    Where some layers have adapters and others are trained in full, the former hold both.
    """
    config, metadata = run.config, _metadata(run)
    if rules.trains_base(config):
        _write_base(run.folder, run.policy, metadata)
        return
    metadata = {"base": hub.portable_path(config.model.source), **metadata}
    if config.model.base_dtype:
        metadata[QUANTIZED] = config.model.base_dtype
    native.save_adapters(run.folder, run.policy.model, base=run.base_hash, metadata=metadata)


def write_variant(
    folder: Path,
    policy: Policy,
    source: Path,
    *,
    tasks: Sequence[str] = (),
    quantized: Kind | None = None,
    record: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Write a policy made from a run's, with frozen weights in bf16, for `load_policy`.

    Args:
        folder: folder to create.
        policy: a policy with adapters, or one without, whose base is then written as well. It may
            have only some of the run's instructions.
        source: folder of the run.
        tasks: what the policy is for; (): the run's tasks.
        quantized: how to quantize the base whenever the policy is loaded.
        record: how the policy was made, which its metadata then say.

    Raises:
        ValueError: the policy has learned its initial noise, which is that of its weights.
    """
    if policy.model.noise_actor is not None:
        raise ValueError(
            f"the policy of {source} has learned its initial noise: it has no variants"
        )
    metadata = describe(source)
    prompts = policy.processor.prompts
    fields = metadata["policy"] | {
        "config": dataclasses.asdict(policy.model.config),
        "prompts": _prompts_digest(prompts),
        "instructions": list(prompts.instructions),
    }
    metadata |= {"policy": fields, QUANTIZED: quantized, STEPS: denoise_steps(source)}
    metadata |= {"tasks": list(tasks)} if tasks else {}
    metadata |= record
    if adaptation.methods(policy.model):
        base = native.read_description(source)["base"]
        native.save_adapters(folder, policy.model, base=base, metadata=metadata)
    else:
        _write_base(folder, policy, metadata)


def _write_base(folder: Path, policy: Policy, metadata: Mapping[str, Any]) -> None:
    models.save(folder / BASE, adaptation.merge(policy.model))
    statistics = policy.processor.statistics.to_json()
    (folder / BASE / "statistics.json").write_text(statistics + "\n")
    write_json(folder / BASE / TRAINING, metadata)


def _metadata(run: Run) -> dict[str, Any]:
    """Describe the training data and everything that the policy needs besides weights."""
    config, first = run.config, next(iter(run.episodes.values()))
    processor = run.policy.processor
    several, each = processor.datasets, config.data.statistics == "each"
    names = several.names if several and (each or several.present) else ()
    robots = {name: _robot(processor.of_dataset(name)) for name in names}
    default = names[0] if names and each else ""
    return {
        "robot": config.robot,
        "tasks": list(run.episodes),
        "control_dt": first.control_dt,
        "physics_dt": first.physics_dt,
        **_dimensions(run),
        "policy": {
            "backbone": config.model.backbone,
            "config": dataclasses.asdict(run.policy.model.config),
            "tokenizer": hub.portable_path(config.model.tokenizer),
            "prompts": _prompts_digest(processor.prompts),
            "instructions": list(processor.prompts.instructions),
            **_endings(processor.prompts),
            "num_joints": len(processor.state_slots) - 1,
            "action_length": len(processor.action_slots),
            **(robots[default] if default else _robot(processor)),
            **({"dataset": default, "datasets": robots} if robots else {}),
        },
    }


def _dimensions(run: Run) -> dict[str, dict[str, list[str]]]:
    """Describe `DIMENSIONS`; datasets have names at most, as no format records units."""
    if run.recordings and not run.simulated:
        return {"names": names} if (names := dimension_names(run.recordings)) else {}
    joints = len(run.policy.processor.state_slots) - 1
    both = [*joint_names(joints), "gripper"], [*(["rad"] * joints), "m"]
    return {
        key: dict.fromkeys(("state", "action"), x) for key, x in zip(DIMENSIONS, both, strict=True)
    }


def _endings(prompts: PromptTable) -> dict[str, Any]:
    """Describe the endings of prompts, if there are any."""
    return {"endings": list(prompts.endings)} if any(prompts.endings) else {}


def _robot(processor: Processor) -> dict[str, Any]:
    """Describe what differs between the datasets of a run."""
    cameras = {slot: name for slot, name in processor.cameras if name}
    return {"cameras": cameras, "statistics": json.loads(processor.statistics.to_json())}


def load_policy(
    folder: str | os.PathLike[str],
    *,
    base: str = "",
    words: str = "",
    any_base: bool = False,
    dataset: str = "",
) -> Policy:
    """Load the policy of a finished run, with a base quantized as in training.

    Args:
        folder: folder of the run.
        base: location of the frozen base (see `models.load`); default: the recorded one.
        words: location of the tokenizer; default: the recorded one.
        any_base: accept a base whose weights differ from the original's (see `load_adapters`).
        dataset: for whose robot the policy acts, where datasets differ in statistics or cameras;
            default: the first with its own statistics, or all.

    Returns:
        The policy; `Policy.sample` takes indices into `processor.prompts.instructions`.

    Raises:
        ValueError: there is no such folder, the run is not finished, its files are corrupt, there
            is no such dataset, or the base is missing or differs from the one used in training.
    """
    recorded = RecordedPolicy.read(folder, base=base, dataset=dataset)
    model = recorded.load_base()
    if recorded.noise_actor:
        model = noise_actor.attach(model, recorded.noise_actor)
    if not recorded.is_full:
        model = native.load_adapters(recorded.folder, model, any_base=any_base)
    graphdef, state = nnx.split(quantized(model, recorded.quantized))
    model = nnx.merge(graphdef, jax.tree.map(jnp.asarray, state))  # also adapters from the host
    return Policy(model, recorded.processor(words))


@dataclasses.dataclass(frozen=True)
class RecordedPolicy:
    """What the files of a finished run say of its policy.

    Attributes:
        folder: of the run.
        source: location of the base.
        config: of the model.
        is_full: whether the run trained its base, which is then in its folder.
        quantized: how the base is quantized after loading, or None.
        noise_actor: of the shapes of the policy's, which is saved with its adapters; None: it has
            none.
        fields: what the processor is made of.
    """

    folder: Path
    source: str | Path
    config: BackboneConfig
    is_full: bool
    quantized: Kind | None
    noise_actor: NoiseActor | None
    fields: Mapping[str, Any] = dataclasses.field(repr=False)

    @classmethod
    def read(
        cls, folder: str | os.PathLike[str], *, base: str = "", dataset: str = ""
    ) -> "RecordedPolicy":
        """Read a run's files; arguments and errors are those of `load_policy`."""
        folder = Path(folder)
        metadata, path, is_full = _read_metadata(folder)
        if dataset and dataset not in (known := datasets(metadata)):
            names = ", ".join(known) or "all its datasets alike"
            raise ValueError(f"the policy of {folder} acts for {names}, not for {dataset!r}")
        try:
            policy = metadata["policy"]
            policy = policy | (policy["datasets"][dataset] if dataset else {})
            config = _config(policy)
            source = folder / BASE if is_full else base or hub.resolve_portable(metadata["base"])
            chooses = metadata.get(noise_actor.PATH)
            actor = NoiseActor.blank(config, **chooses) if chooses else None
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} does not describe a policy") from error
        if not source:
            raise ValueError(f"the base of {folder} was randomly initialized and not saved")
        return cls(folder, source, config, is_full, metadata.get(QUANTIZED), actor, policy)

    def load_base(self) -> Any:
        """Load the base, not yet quantized; in host memory if it is to be."""
        load = functools.partial(models.load, self.source, self.config)
        try:
            return on_host(load) if self.quantized else load()
        except ValueError as error:
            hint = "" if self.is_full else f"; pass base= if the base of {self.folder} has moved"
            raise ValueError(f"{error}{hint}") from error

    def processor(self, words: str = "") -> Processor:
        """Make the processor; `words` is the location of the tokenizer, or "" as recorded."""
        try:
            return _processor(self.fields, self.config, words)
        except (KeyError, TypeError) as error:
            raise ValueError(f"the files of {self.folder} do not describe a policy") from error


def describe(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Return what a finished run recorded about its policy: robot, tasks, periods, processor.

    Raises:
        ValueError: there is no such folder, the run is not finished, or its files are corrupt.
    """
    return _read_metadata(Path(folder))[0]


def denoise_steps(folder: str | os.PathLike[str]) -> int:
    """Return the flow steps per chunk with which a finished run was evaluated.

    `NUM_STEPS` if its folder does not say. Errors are those of `describe`.
    """
    config = read_json(Path(folder) / CONFIG_FILE, {"evaluation": {STEPS: int}})
    return config["evaluation"][STEPS] if config else describe(folder).get(STEPS, NUM_STEPS)


def datasets(metadata: Mapping[str, Any]) -> list[str]:
    """Return the names of datasets with own statistics or cameras, from `describe`'s result."""
    return [*metadata["policy"].get("datasets", {})]


def is_run(folder: str | os.PathLike[str]) -> bool:
    """Return whether this is the folder of a finished run."""
    return (Path(folder) / BASE).is_dir() or (Path(folder) / native.DESCRIPTION).is_file()


def _read_metadata(folder: Path) -> tuple[dict[str, Any], Path, bool]:
    """Return a run's metadata, their file, and whether the run trained its base."""
    if not folder.is_dir():
        raise ValueError(f"there is no folder {folder}")
    is_full = (folder / BASE).is_dir()
    path = folder / BASE / TRAINING if is_full else folder / native.DESCRIPTION
    if not path.is_file():
        raise ValueError(f"{folder} contains no policy: no run has finished there")
    metadata = read_json(path) if is_full else native.read_description(folder)["metadata"]
    return metadata, path, is_full


def _config(policy: Mapping[str, Any]) -> BackboneConfig:
    """Return the config of a policy's backbone."""
    config = backbone.find(policy["backbone"]).from_dict(policy["config"])
    # Older runs have the mask of relative actions beside the config, which may have the base's.
    delta = tuple(policy.get("relative", config.inputs.delta))
    return dataclasses.replace(config, inputs=dataclasses.replace(config.inputs, delta=delta))


def _processor(policy: Mapping[str, Any], config: BackboneConfig, words: str) -> Processor:
    joints = policy["num_joints"]
    try:
        loaded = tokenizer.load_tokenizer(words or hub.resolve_portable(policy["tokenizer"]))
    except ValueError as error:
        raise ValueError(f"{error}; pass words= if the policy's tokenizer has moved") from error
    more = {"num_joints": joints, "endings": policy.get("endings", ("",))}
    prompts = PromptTable.of(loaded, policy["instructions"], config, **more)
    if _prompts_digest(prompts) != policy["prompts"]:
        raise ValueError(
            f"the tokenizer {words or policy['tokenizer'] or 'of this version'} produces "
            "different tokens than in training: pass words= with the location of the original"
        )
    return Processor.of(
        config,
        Statistics.from_json(json.dumps(policy["statistics"])),
        prompts,
        num_joints=joints,
        action_length=policy.get("action_length"),  # older runs: as long as states
        cameras=policy["cameras"],
    )


def _prompts_digest(prompts: PromptTable) -> str:
    """Return a digest of the prompts' tokens, which reveals a change of the tokenizer."""
    leaves = jax.tree_util.tree_leaves_with_path(prompts)
    return digest({jax.tree_util.keystr(path): jnp.asarray(leaf) for path, leaf in leaves})
