"""Load and run exported policies (`lorasp_jax.extras.serving.export`) without this package.

This file needs only JAX with flatbuffers, NumPy and safetensors. A copy of it works on its own.

    policy.json            sizes, versions, and the SHA-256 digest of every other file
    processor.json         normalization; the programs take its statistics as an argument
    instructions.json      tokens of each instruction
    weights.safetensors    arrays that the programs take as an argument, in the order of their names
    act-B.bin              program of `jax.export` for B observations
    continue-B.bin         the same for chunks that continue the previous one

A bundle is a folder of several such policies with one base: adapters.json has their names, the
first is the default. Weights of the base and programs are beside their folders, and policy.json
says which they use.
"""

import functools
import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
from jax import export

FORMAT = 1
"""Version of the folder's layout."""
PLATFORMS = ("cpu", "cuda")
"""Platforms that every program runs on."""
DESCRIPTION = "policy.json"
BUNDLE, BASE = "adapters.json", "base.safetensors"
PROCESSOR, INSTRUCTIONS, WEIGHTS = "processor.json", "instructions.json", "weights.safetensors"
ACT, CONTINUE = "act", "continue"
"""Kinds of programs."""
_NAME = re.compile(r"\w[\w.-]*")
"""Names of a bundle's policies and files, which are never paths to elsewhere."""
_REMEDY = "copy the folder or export the policy again"


@dataclass(frozen=True)
class PolicyInterface:
    """What a policy needs to know of a robot, and what it returns.

    Attributes:
        cameras: names of the robot's cameras; the third-person view comes first.
        image_size: S, height and width of pictures [pixels].
        state_dim: J+1, the length of states.
        chunk: C, actions per call.
        masks_missing: whether the policy works without some of its cameras.
        centred: whether pictures that are not square were padded on both sides in training.
        antialias: whether they were smoothed before downsampling.
        action_length: length of actions; 0: J+1, too.
    """

    cameras: tuple[str, ...]
    image_size: int
    state_dim: int
    chunk: int
    masks_missing: bool = False
    centred: bool = True
    antialias: bool = True
    action_length: int = 0

    def __post_init__(self) -> None:
        if not self.action_length:
            object.__setattr__(self, "action_length", self.state_dim)


@dataclass(frozen=True, kw_only=True)
class Description(PolicyInterface):
    """What is known of a policy.

    Attributes:
        action_dim: A, the length of the noise's vectors.
        num_steps: flow steps.
        batch_sizes: numbers of observations that there are programs for, ascending.
        continues: whether a chunk can continue the previous one.
        metadata: what the run says of its robot.
    """

    action_dim: int
    num_steps: int
    batch_sizes: Sequence[int]
    continues: bool
    metadata: Mapping[str, Any] = field(default_factory=dict)

    @property
    def programs(self) -> list[tuple[str, int]]:
        """Kind and batch size of each program."""
        kinds = (ACT, CONTINUE) if self.continues else (ACT,)
        return [(kind, size) for kind in kinds for size in self.batch_sizes]

    @property
    def files(self) -> list[str]:
        """Names of all files but `DESCRIPTION`."""
        return [PROCESSOR, INSTRUCTIONS, WEIGHTS, *(program_file(*each) for each in self.programs)]


def sampling_options() -> dict[str, str | bool] | None:
    """Return the compiler options of a program that samples a chunk for a few observations.

    Its kernels take microseconds, and XLA's CUDA graphs run independent ones one after another
    unless told otherwise: on an H200, pi0 takes 17.0 instead of 17.8 ms in 10 flow steps, with
    LoRA-SP 29.5 instead of 30.9.
    """
    if jax.default_backend() != "gpu" or jax.__version_info__ < (0, 11):
        return None
    return {"xla_gpu_command_buffer_scheduling_mode": "CONCURRENT"}


class ExportedPolicy:
    """A policy with programs for fixed batch sizes, which compile when first used; see `load`."""

    def __init__(
        self,
        description: Description,
        programs: Mapping[tuple[str, int], Any],
        weights: list[jax.Array],
        statistics: Any,
        tokens: Mapping[str, Mapping[str, Any]],
    ) -> None:
        self.description = description
        self._programs = dict(programs)
        self._weights, self._statistics, self._tokens = weights, statistics, tokens

    @property
    def instructions(self) -> tuple[str, ...]:
        """The instructions that the policy understands."""
        return tuple(self._tokens)

    @property
    def noise_shape(self) -> tuple[int, int]:
        """(C, A)."""
        return self.description.chunk, self.description.action_dim

    def act(
        self,
        images: Mapping[str, np.ndarray],
        state: np.ndarray,
        instruction: str,
        noise: np.ndarray,
        previous: np.ndarray | None = None,
        delay: int = 0,
    ) -> np.ndarray:
        """Return a chunk of actions for one observation.

        Args:
            images: camera -> uint8 `[S, S, 3]`.
            state: f32 `[J+1]`, joints [rad] and gripper [m].
            instruction: one of `instructions`.
            noise: f32 `noise_shape`, standard normal; equal inputs give equal actions.
            previous: f32 `[P, n]`, what remains of the previous chunk, P from 0 to C. The new one
                continues it (real-time chunking).
            delay: number of these actions that the robot executes before it switches.

        Returns:
            f32 `[C, n]`, joint targets [rad] and gripper opening [m]; n is `action_length`.

        Raises:
            ValueError: an input does not fit, or the policy cannot continue chunks.
        """
        self._check_observation(images, state, noise)
        self._check_continuation(previous, delay)
        tokens = self.tokens(instruction)
        row = build_row(self.description, images, state, tokens, previous, delay)
        return self.run(jax.tree.map(lambda leaf: leaf[None], {**row, "noise": noise}))[0]

    def tokens(self, instruction: str) -> Mapping[str, np.ndarray]:
        """Return the tokens of an instruction, `ids` and `mask` `[T]`.

        Raises:
            ValueError: the policy does not know it.
        """
        if instruction not in self._tokens:
            known = ", ".join(map(repr, self._tokens))
            known = known if len(known) < 500 else f"{known[:500]}..."
            raise ValueError(f"the instruction must be one of {known}, got {instruction!r}")
        return self._tokens[instruction]

    def run(self, batch: Mapping[str, Any]) -> np.ndarray:
        """Return actions f32 `[B, C, n]`.

        Args:
            batch: B rows of `build_row`, stacked, and their `noise` `[B, C, A]`; B is one of
                `description.batch_sizes`.
        """
        program = self._programs[CONTINUE if "previous" in batch else ACT, len(batch["state"])]
        return np.asarray(program(self._weights, self._statistics, batch))

    def _check_observation(self, images: Any, state: Any, noise: Any) -> None:
        needs = self.description
        given, known = set(images), set(needs.cameras)
        if given != known and not (needs.masks_missing and given and given < known):
            raise ValueError(
                f"images must be those of the cameras {', '.join(needs.cameras)}, got "
                f"{', '.join(images) or 'none'}"
            )
        for name, image in images.items():
            shape = (needs.image_size, needs.image_size, 3)
            _check(f"the image of {name}", image, shape, np.uint8)
        _check("state", state, (needs.state_dim,), np.float32)
        _check("noise", noise, self.noise_shape, np.float32)

    def _check_continuation(self, previous: Any, delay: Any) -> None:
        if previous is None:
            if delay != 0:
                raise ValueError(f"delay {delay} was given without previous")
            return
        if not self.description.continues:
            raise ValueError(
                "the policy was not trained to continue chunks (--optim.rtc-max-delay): leave out "
                "previous"
            )
        chunk, rows = self.description.chunk, np.shape(previous)[:1]
        length = rows[0] if rows and rows[0] <= chunk else chunk
        _check("previous", previous, (length, self.description.action_length), np.float32)
        if not isinstance(delay, int | np.integer) or not 0 <= delay <= length:
            raise ValueError(
                f"delay must be an integer from 0 to {length}, the length of previous, got {delay}"
            )


def build_row(
    needs: PolicyInterface,
    images: Mapping[str, np.ndarray],
    state: np.ndarray,
    tokens: Mapping[str, np.ndarray],
    previous: np.ndarray | None = None,
    delay: int = 0,
) -> dict[str, Any]:
    """Return the inputs of a policy for one observation, apart from the noise.

    Args:
        needs: the policy's.
        images: as in `ExportedPolicy.act`; cameras without a picture are masked.
        state: f32 `[J+1]`.
        tokens: `ids` and `mask` `[T]` of the instruction.
        previous: f32 `[P, n]`, what remains of the previous chunk; None: chunks are independent.
        delay: number of these actions that the robot executes before it switches.
    """
    black = np.zeros((needs.image_size, needs.image_size, 3), np.uint8)
    row = {
        "images": {name: images.get(name, black) for name in needs.cameras},
        "present": {name: np.array(name in images) for name in needs.cameras},
        "state": state,
        **tokens,
    }
    if previous is None:
        return row
    padded = np.zeros((needs.chunk, needs.action_length), np.float32)
    padded[: len(previous)] = previous
    return row | {"previous": padded, "delay": np.array(delay, np.int32)}


def load(folder: str | os.PathLike[str]) -> ExportedPolicy:
    """Load an exported policy, which may be one of a bundle.

    Raises:
        ValueError: the folder contains none, a file is damaged or missing, or a newer version of
            JAX wrote it.
    """
    return _Reader().policy(Path(folder))


def load_bundle(folder: str | os.PathLike[str]) -> dict[str, ExportedPolicy]:
    """Load a bundle: policies by name, which share the base's arrays and programs.

    Raises:
        ValueError: as for `load`.
    """
    reader, path = _Reader(), Path(folder) / BUNDLE
    try:
        names = json.loads(path.read_bytes())
        if not names or not all(map(_NAME.fullmatch, names)):
            raise ValueError
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} is missing or damaged: {_REMEDY}") from error
    return {name: reader.policy(Path(folder) / name) for name in names}


class _Reader:
    """Reads policies, and files that several of them use only once."""

    def __init__(self) -> None:
        self._digests = functools.cache(file_digest)
        self._program = functools.cache(_program)
        self._weights = functools.cache(_weights)

    def policy(self, folder: Path) -> ExportedPolicy:
        values = _read_description(folder / DESCRIPTION)
        if tuple(values["jax"]) > jax.__version_info__:
            name = ".".join(map(str, values["jax"]))
            raise ValueError(
                f"{folder} was exported with JAX {name}, which JAX {jax.__version__} may not run: "
                f"install JAX {name}, or export the policy again"
            )
        fields, beside = values["policy"], values.get("beside", {})
        description = Description(**fields | {"cameras": tuple(fields["cameras"])})
        base = [BASE] if BASE in beside else []
        paths = {n: folder / n for n in (*description.files, *base)}
        paths |= {n: folder.parent / file for n, file in beside.items() if _NAME.fullmatch(file)}
        for name, path in paths.items():
            if not path.is_file() or self._digests(path) != values["files"].get(name):
                raise ValueError(f"{path} is missing or damaged: {_REMEDY}")
        arrays = (self._weights(paths[BASE]) if base else {}) | self._weights(paths[WEIGHTS])
        return ExportedPolicy(
            description,
            {each: self._program(paths[program_file(*each)]) for each in description.programs},
            [arrays[name] for name in values.get("weights", sorted(arrays))],
            _statistics(folder / PROCESSOR),
            _tokens(folder / INSTRUCTIONS),
        )


def _program(path: Path) -> Any:
    exported = export.deserialize(bytearray(path.read_bytes()))
    return jax.jit(exported.call, compiler_options=sampling_options())


def _weights(path: Path) -> dict[str, jax.Array]:
    with safetensors.safe_open(path, framework="np") as file:
        return {name: jnp.asarray(file.get_tensor(name)) for name in file.keys()}  # noqa: SIM118


def _statistics(path: Path) -> dict[str, dict[str, jax.Array]]:
    by_kind = json.loads(path.read_bytes())["statistics"]
    return {
        kind: {name: jnp.array(values, jnp.float32) for name, values in by_name.items()}
        for kind, by_name in by_kind.items()
    }


def _tokens(path: Path) -> dict[str, dict[str, np.ndarray]]:
    return {
        text: {"ids": np.array(row["ids"], np.int32), "mask": np.array(row["mask"], np.bool_)}
        for text, row in json.loads(path.read_bytes()).items()
    }


def is_bundle(folder: str | os.PathLike[str]) -> bool:
    """Return whether a folder contains several exported policies of one base."""
    return (Path(folder) / BUNDLE).is_file()


def is_exported(folder: str | os.PathLike[str]) -> bool:
    """Return whether a folder contains an exported policy."""
    return (Path(folder) / DESCRIPTION).is_file()


def program_file(kind: str, batch: int) -> str:
    """Return the name of a program's file."""
    return f"{kind}-{batch}.bin"


def file_digest(path: Path) -> str:
    """Return the hexadecimal SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest(values: Mapping[str, Any]) -> str:
    """Return the hexadecimal SHA-256 of JSON values, independent of formatting."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _read_description(path: Path) -> dict[str, Any]:
    """Read policy.json, and check its format and its digest."""
    if not path.is_file():
        raise ValueError(f"{path.parent} contains no exported policy: it lacks {path.name}")
    try:
        values = json.loads(path.read_bytes())
        version, expected = values["format"], values.pop("digest", "")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: {_REMEDY}") from error
    if version != FORMAT:
        raise ValueError(f"{path.parent} has format {version}, not {FORMAT}: export it again")
    if digest(values) != expected:
        raise ValueError(f"{path} is damaged: {_REMEDY}")
    return values


def _check(name: str, array: Any, shape: tuple[int, ...], dtype: type[np.generic]) -> None:
    """Raise ValueError unless an input is a finite array of this shape and dtype."""
    is_array = isinstance(array, np.ndarray)
    if not is_array or array.shape != shape or array.dtype != dtype:
        got = f"{array.dtype} {list(array.shape)}" if is_array else type(array).__name__
        raise ValueError(f"{name} must be {np.dtype(dtype)} {list(shape)}, got {got}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite")
