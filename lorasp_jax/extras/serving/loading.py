"""Load what a server serves: finished runs, or a published checkpoint with or without adapters."""

import dataclasses
import functools
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import lorasp_jax
from lorasp_jax.adapters.io import hugging_face
from lorasp_jax.base import hub
from lorasp_jax.extras.serving.checkpoint import Checkpoint, Unsaid
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.sampling import NUM_STEPS
from lorasp_jax.models.shared_base import SharedBase
from lorasp_jax.policies import statistics_files
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.tokenizer import Tokenizer, load_tokenizer
from lorasp_jax.training import export
from lorasp_jax.training.export import RecordedPolicy
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
        base: the base that its adapters share with others, if they do.
        denoise_steps: flow steps per chunk: those of the run's evaluation.
    """

    policy: Policy
    words: Tokenizer
    continues: bool | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)
    base: SharedBase | None = None
    denoise_steps: int = NUM_STEPS

    def with_adapters(self, folder: str, any_base: bool = False) -> "Loaded":
        """Return this policy with other adapters on its shared base; see `load_checkpoint`."""
        assert self.base is not None
        if _is_peft(folder):
            model = self.base.attach_with(functools.partial(_with_peft, folder))
        else:
            model = self.base.read(folder, any_base=any_base)
        return replace(self, policy=replace(self.policy, model=model))


def load_run(
    folder: str,
    *,
    base: str = "",
    words: str = "",
    dataset: str = "",
    any_base: bool = False,
    model: Callable[[RecordedPolicy], Any] | None = None,
) -> Loaded:
    """Load a finished run; arguments and errors are those of `load_policy`.

    With `model`, that function makes the model from what the run records. Says for which dataset's
    robot the policy acts if there is a choice.
    """
    described = export.describe(folder)
    if known := export.datasets(described):
        chosen = dataset or described["policy"]["dataset"] or "all its datasets"
        others = f"--dataset chooses one of {', '.join(known)}"
        print(f"{folder} acts for {chosen}; {others}", file=sys.stderr)
    if model is None:
        where: Any = {"base": base, "words": words, "dataset": dataset}
        policy = export.load_policy(folder, **where, any_base=any_base)
    else:
        said = RecordedPolicy.read(folder, base=base, dataset=dataset)
        policy = Policy(model(said), said.processor(words))
    recorded = hub.resolve_portable(described["policy"]["tokenizer"])
    dimensions = {key: described[key] for key in export.DIMENSIONS if key in described}
    config = read_json(Path(folder) / CONFIG_FILE, {"optim": {}})
    return Loaded(
        policy,
        load_tokenizer(words or recorded),
        continues=bool(config["optim"].get("rtc_max_delay")) if config else None,
        metadata={key: described.get(key) for key in ("robot", "control_dt")} | dimensions,
        denoise_steps=export.denoise_steps(folder),
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
    any_base: bool = False,
    share: bool = False,
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
        any_base: accept adapters of another base; see `load_adapters`.
        share: keep the base in memory once for all adapters; see `SharedBase`.
        unsaid: fields of `Unsaid`.

    Raises:
        ValueError: something is missing or does not fit; see `models.load`, `statistics_files.read`
            and `Processor.of`.
    """
    checkpoint = Checkpoint.find(where, Unsaid(**unsaid))
    config, named = checkpoint.config, checkpoint.named
    if dtype:
        config = dataclasses.replace(config, dtype=dtype, param_dtype=dtype)
    given = {"tokenizer": tokenizer, "statistics": statistics, "dataset": dataset}
    processor, words = _processor(checkpoint, config, **given, cameras=cameras)
    model = checkpoint.found.load(config)
    models = {UNADAPTED: model}
    models |= {name: _adapted(path, model, any_base) for name, path in (adapters or {}).items()}
    base = SharedBase(model) if share else None
    if base:
        models = {name: base.attach_model(each, model) for name, each in models.items()}
    pose = {"reset_pose": [*named.reset_pose]} if named and named.reset_pose else {}
    return {
        name: Loaded(Policy(each, processor), words, metadata=pose, base=base)
        for name, each in models.items()
    }


def _processor(
    checkpoint: Checkpoint,
    config: BackboneConfig,
    *,
    tokenizer: str,
    statistics: str,
    dataset: str,
    cameras: Mapping[str, str] | None,
) -> tuple[Processor, Tokenizer]:
    """Return the processor of a checkpoint and its tokenizer; see `load_checkpoint`."""
    moments = statistics_files.read(
        statistics or checkpoint.found.folder, dataset=dataset, default=checkpoint.dataset
    )
    joints, length = checkpoint.lengths(moments)
    words = load_tokenizer(tokenizer or checkpoint.tokenizer)
    # The instructions come with the requests; without a default, this one measures the table.
    prompt = checkpoint.named.prompt if checkpoint.named else ""
    prompts = PromptTable.of(words, [prompt or "press the button"], config, num_joints=joints)
    prompts = dataclasses.replace(prompts, instructions=(prompt,) if prompt else ())
    cameras = cameras or checkpoint.cameras or None
    sizes: Any = {"num_joints": joints, "action_length": length}
    return Processor.of(config, moments, prompts, **sizes, cameras=cameras), words


def _adapted(where: str, model: Backbone, any_base: bool) -> Backbone:
    """Return the model with the adapters of a folder."""
    if _is_peft(where):
        return _with_peft(where, model)
    return lorasp_jax.load_adapters(where, model, any_base=any_base)


def _is_peft(where: str) -> bool:
    return hub.is_remote(where) or (Path(where) / hugging_face.CONFIG).exists()


def _with_peft(where: str, model: Backbone) -> Backbone:
    print(f"{where} has no digest of its base: taking this checkpoint", file=sys.stderr)
    return lorasp_jax.load_peft(where, model, names=lorasp_jax.models.lerobot_names(model))
