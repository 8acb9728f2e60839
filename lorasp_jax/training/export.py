"""What a finished run hands on, adapters or with full fine-tuning a new base, and its way back."""

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from lorasp_jax import models
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import native
from lorasp_jax.models import backbone
from lorasp_jax.policies import tokenizer
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.statistics import Statistics
from lorasp_jax.storage import hub
from lorasp_jax.storage.digest import digest
from lorasp_jax.training.base import TRAINING
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import read_json, write_json

BASE = "base"
"""Folder of a base that was trained itself."""


class Export(Callback):
    """`write` after the last step."""

    def on_end(self, run: Run) -> None:
        """Write the trained policy."""
        write(run)


def write(run: Run) -> None:
    """Write adapter.safetensors and adapter.json, or `base` if the base itself was trained."""
    config, facts = run.config, _facts(run)
    if config.peft.trains_base:
        folder = run.folder / BASE
        models.save(folder, adaptation.merge(run.policy.model))
        statistics = run.policy.processor.statistics.to_json()
        (folder / "statistics.json").write_text(statistics + "\n")
        write_json(folder / TRAINING, facts)
        return
    metadata = {"base": hub.portable_path(config.model.source), **facts}
    native.save_adapters(run.folder, run.policy.model, base=run.base_hash, metadata=metadata)


def _facts(run: Run) -> dict[str, Any]:
    """What the weights were trained on, and what their policy needs beside them."""
    config, first = run.config, next(iter(run.episodes.values()))
    processor = run.policy.processor
    return {
        "robot": config.robot,
        "tasks": list(config.tasks),
        "control_dt": first.control_dt,
        "physics_dt": first.physics_dt,
        "policy": {
            "backbone": config.model.backbone,
            "config": dataclasses.asdict(run.policy.model.config),
            "tokenizer": hub.portable_path(config.model.tokenizer),
            "prompts": _prompts_digest(processor.prompts),
            "instructions": list(processor.prompts.instructions),
            "num_joints": len(processor.robot_slots) - 1,
            "cameras": {place: name for place, name in processor.cameras if name},
            "relative": list(processor.inputs.delta),
            "statistics": json.loads(processor.statistics.to_json()),
        },
    }


def load_policy(
    folder: str | os.PathLike[str], *, base: str = "", words: str = "", any_base: bool = False
) -> Policy:
    """The policy that a finished run left.

    Args:
        folder: of the run.
        base: where the frozen base is now, see `models.load`; by default where it was.
        words: likewise the tokenizer.
        any_base: whether other weights than those trained on will do, see `load_adapters`.

    Returns:
        The policy; `Policy.sample` takes the rows of `processor.prompts.instructions`.

    Raises:
        ValueError: no finished run, or damaged files; a base that is not there or not the run's.
    """
    folder = Path(folder)
    trained = (folder / BASE).is_dir()
    path = folder / BASE / TRAINING if trained else folder / native.DESCRIPTION
    if not path.is_file():
        raise ValueError(f"{folder} has no policy: no run finished there")
    told = read_json(path) if trained else native.read_description(folder)["metadata"]
    try:
        config = backbone.find(told["policy"]["backbone"]).from_dict(told["policy"]["config"])
        source = folder / BASE if trained else base or hub.resolve_portable(told["base"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} does not say what its policy needs") from error
    if not source:
        raise ValueError(f"the base of {folder} was random, and nothing keeps it")
    try:
        model = models.load(source, config)
    except ValueError as error:
        hint = "" if trained else f" (base= says where the base of {folder} is now)"
        raise ValueError(f"{error}{hint}") from error
    if not trained:
        model = native.load_adapters(folder, model, any_base=any_base)
    try:
        return Policy(model, _processor(told["policy"], config, words))
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path} does not say what its policy needs") from error


def _processor(told: Mapping[str, Any], config: Any, words: str) -> Processor:
    """The processor of an exported policy."""
    joints = told["num_joints"]
    try:
        found = tokenizer.load_tokenizer(words or hub.resolve_portable(told["tokenizer"]))
    except ValueError as error:
        raise ValueError(f"{error} (words= says where the policy's tokenizer is now)") from error
    prompts = PromptTable.of(found, told["instructions"], config, num_joints=joints)
    if _prompts_digest(prompts) != told["prompts"]:
        raise ValueError(
            f"the tokenizer {words or told['tokenizer'] or 'of this version'} gives other tokens "
            "than the policy was trained on: words= says where its own is now"
        )
    return Processor.of(
        config,
        Statistics.from_json(json.dumps(told["statistics"])),
        prompts,
        num_joints=joints,
        cameras=told["cameras"],
        delta=told["relative"],
    )


def _prompts_digest(prompts: PromptTable) -> str:
    """The identity of a tokenizer, as far as a policy sees it: the tokens of its prompts."""
    leaves = jax.tree_util.tree_leaves_with_path(prompts)
    return digest({jax.tree_util.keystr(path): jnp.asarray(leaf) for path, leaf in leaves})
