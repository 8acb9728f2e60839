"""Train on from a LoRA-SP run, and leave the directions that it uses as they are.

A direction is used if it is active for at least `LEAST` of the valid tokens of the run's own data.
Its rows of U, V and the router's outputs stay, and so does the router's hidden layer, which all
directions share. The rest trains, and the energy gate chooses among all. What the start run has
itself protected stays, too.
"""

import dataclasses
import operator
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from flax import nnx
from rich.console import Console
from rich.table import Table

from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.compress import pruning
from lorasp_jax.config import Config
from lorasp_jax.dense import AdaptedLayer, AdapterParam
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.peft.lora_sp.bank import BankMethod
from lorasp_jax.peft.method import Params
from lorasp_jax.policies.processor import Processor
from lorasp_jax.training import activations, fixed_batches, records, rules, start
from lorasp_jax.training.demonstrations import Demonstrations, are_cached
from lorasp_jax.training.distributed import processes
from lorasp_jax.training.export import RecordedPolicy
from lorasp_jax.training.finished_run import recorded_config
from lorasp_jax.training.run import Run
from lorasp_jax.training.run_folder import CONFIG_FILE, read_json, write_json

FILE = "protected.json"
"""Protected directions in a run's folder: "1" or "0" for each, by path and layer of the stack."""
LEAST = 0.05
"""Share of tokens for which a direction in use is active, at least."""
ROOM = 0.05
"""Share of free directions below which a run is warned that it has few to learn with."""
_SAME = (
    *("model.backbone", "model.size", "model.relative_actions", "model.chunk", "model.max_tokens"),
    *("model.tokenizer", "robot", "image_size", "control_dt", "targets", "adapt", "peft.name"),
)
"""Settings that both runs share."""

Protected = Mapping[str, np.ndarray]
"""Path of an adapted layer -> bool `[..., R]`, with the leading axes of its kernel."""


def check(config: Config) -> None:
    """Raise ValueError if a run cannot protect the directions of the one that it names.

    That one is gone, not finished, has adapters other than LoRA-SP's or different settings, or
    trained on several datasets; or the run averages its adapters or has several datasets itself.
    """
    folder = Path(config.protect)
    if not folder.is_dir():
        raise ValueError(
            f"there is no folder {folder}, whose run is to be protected: if it has moved, leave a "
            "link in its place"
        )
    recorded = recorded_config(folder, simulated=False)
    start.with_kept(config, folder, recorded, (), ())
    others = [x.name for x in rules.methods(recorded) if not isinstance(x, BankMethod)]
    if others:
        raise ValueError(f"{folder} has {others[0]} adapters: only LoRA-SP's can be protected")
    for name in (*_SAME, *(f"peft.{field}" for field in vars(config.peft))):
        own, theirs = map(operator.attrgetter(name), (config, recorded))
        # The robot of a dataset is known later.
        if own != theirs and not (name == "robot" and config.data.source):
            raise ValueError(
                f"{name} must be that of {folder}, whose directions are protected: {theirs}, got "
                f"{own}"
            )
    if config.learn == "recap":
        raise ValueError("--learn recap cannot be combined with --protect: its prompts differ")
    learned = read_json(folder / CONFIG_FILE, records.CONFIG).keys() & {"online", "distill"}
    if learned:
        raise ValueError(
            f"{folder} has learned without data of its own ({learned.pop()}), which would show the "
            "directions that it uses: protect the run that it started from"
        )
    if config.optim.ema:
        raise ValueError("--optim.ema cannot be combined with --protect: averaging rounds")
    if len(config.data.source) > 1:
        raise ValueError("--protect takes one dataset: name one in --data.source")


def processor(config: Config) -> Processor:
    """Return that of the start run's policy."""
    return RecordedPolicy.read(config.protect).processor()


def with_statistics(config: Config, inputs: Processor) -> Processor:
    """Return the processor with the statistics of the start run, whose directions know no others.

    Raises:
        ValueError: its robot has other joints.
    """
    known = processor(config)
    slots = ((x.state_slots, x.action_slots) for x in (inputs, known))
    if len({*slots}) > 1 or inputs.inputs != known.inputs:
        raise ValueError(
            f"the data have other joints, cameras or actions than those of {config.protect}"
        )
    return dataclasses.replace(inputs, statistics=known.statistics)


def directions(run: Run, model: Backbone, collect: Callable[..., Demonstrations]) -> Protected:
    """Return the directions that a run protects; they are counted when it begins.

    `model` is the start run's, and `collect` loads or collects its demonstrations.
    """
    with processes.first_process_first("protected"):
        if not (run.folder / FILE).exists():
            folder, lines = Path(run.config.protect), {}
            recorded = recorded_config(folder, simulated=False)
            where = folder
            if not recorded.data.source:  # replayed tasks are the base's
                data = dataclasses.replace(recorded.data, replay=0.0)
                recorded = dataclasses.replace(recorded, data=data)
                if not are_cached(recorded, folder):  # collect here what is gone
                    where = run.folder / "start"
            of_start = start.with_data(recorded, where, model.config, collect)
            found = in_use(of_start, model, processor(run.config), read(folder, model))
            free = Table("free directions", "all layers", "fullest layer", box=None)
            for path, stay in found.items():
                rows = stay.reshape(-1, stay.shape[-1]).astype(int)
                lines[path] = ["".join(map(str, row)) for row in rows]
                share = 1 - rows.mean(1)
                free.add_row(path, f"{share.mean():.0%}", f"{share.min():.0%}")
            run.console.print(free)
            _warn_if_full(run.console, found)
            write_json(run.folder / FILE, lines)
    return read(run.folder, model)


def _warn_if_full(console: Console, protected: Protected) -> None:
    """Say so if less than `ROOM` of all directions are free."""
    free = 1 - np.mean(np.concatenate([each.ravel() for each in protected.values()]))
    if free < ROOM:
        text = f"warning: only {free:.1%} of all directions are free to learn with: give the first "
        text += "run a larger --peft.rank"
        console.print(text, style="yellow", highlight=False, soft_wrap=True)


def in_use(run: Run, model: Backbone, inputs: Processor, earlier: Protected) -> Protected:
    """Return the directions that a model uses on the data of a run, and those of `earlier`."""
    batches = activations.sampled(run, inputs, model.config.chunk)
    used = pruning.usage(model, [*batches], fixed_batches.forward)
    return {path: (shares >= LEAST) | earlier.get(path, False) for path, shares in used.items()}


def read(folder: Path, model: nnx.Module) -> Protected:
    """Read a run's protected directions, {} if it has none; raise ValueError if damaged."""
    lines, like = read_json(folder / FILE, {str: [str]}), _nothing(model)
    if unknown := lines.keys() - like.keys():
        raise ValueError(f"{folder / FILE} is damaged: it has {min(unknown)}, which is no layer")
    rows = {path: [[x == "1" for x in line] for line in each] for path, each in lines.items()}
    return {path: np.array(each).reshape(like[path].shape) for path, each in rows.items()}


def fixed(model: nnx.Module, protected: Protected | None = None) -> Any:
    """Return which parameters stay: a tree like the adapters, of arrays that broadcast to theirs.

    Without protected directions, it has the same shapes.
    """
    model = nnx.clone(model)
    layers = _layers(model)
    for path, rows in (protected or _nothing(model)).items():
        layer = layers[path]
        layer.adapter = AdapterParam(_fixed(layer.method, layer.adapter.get_value(), rows))
    return adaptation.split(model)[1]


def _nothing(model: nnx.Module) -> dict[str, np.ndarray]:
    """Return no direction of any layer; pruned ones, which still have a score, count, too."""
    found = {}
    for path, layer in _layers(model).items():
        scores = layer.adapter.get_value()["router"][layer.method.score_arrays[0]]
        found[path] = np.zeros((*layer.stack_shape(), scores.shape[-1]), bool)
    return found


def _layers(model: nnx.Module) -> dict[str, Any]:
    """Return the adapted layers of a model, or of its shapes, by path; all have LoRA-SP."""
    found = paths.locate(nnx.List([model]), AdaptedLayer)
    return {path: layer for path, _, _, layer in found if layer.adapter is not None}


def _fixed(method: BankMethod, params: Params, rows: np.ndarray) -> Params:
    """Return which parameters of a layer stay, given its protected directions `[..., R]`."""
    bank = rows[..., : method.rank]
    router = {name: np.ones((1,) * x.ndim, bool) for name, x in params["router"].items()}
    for name in method.score_arrays:
        if name in router:
            router[name] = rows if router[name].ndim == rows.ndim else rows[..., None, :]
    return {"bank": {"u": bank[..., None], "v": bank[..., None, :]}, "router": router}
