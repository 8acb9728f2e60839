"""Traced programs, kept between processes beside JAX's compilation cache.

That cache spares XLA's work, but it is asked with the whole program, and MJX takes 6 to 8 s of
Python a scene to trace (measured); what was traced before is read in 0.2 s. The scene, every
source file of this package, every setting of JAX and the versions are part of a program's name, so
a change of any of them traces anew.
"""

import functools
import hashlib
import importlib
import importlib.metadata
import importlib.util
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from jax import export

from envs import tasks
from envs.compilation import fast_cpu
from envs.datasets.writing import write_bytes
from envs.env import Env
from envs.rendering.renderer import RayRenderer
from envs.tasks import Task

# Python traces one program at a time. In turn, the first is compiled and runs while the second is
# traced; all at once, none would start before the last is traced.
_TRACING = threading.Lock()
_VERSIONED = ("jax", "jaxlib", "mujoco", "mujoco-mjx")
_CHECKSUM = hashlib.sha256().digest_size  # bytes, at the beginning of a file


def kept(function: Callable[..., Any]) -> Callable[..., Any]:
    """As `jax.jit(function, static_argnums=0)`, traced once for all processes on this machine.

    Only where a compilation cache is enabled, for tasks of this package, and not where Warp takes
    part, whose programs hold addresses of their process. For threads; not to be vmapped.

    Args:
        function: of an `Env` and trees of arrays, in this package; returns arrays in dicts, lists
            and tuples.
    """
    jitted = fast_cpu.jit(function, static_argnums=0)

    @functools.lru_cache(maxsize=32)
    def program(
        env: Env, tree: Any, kinds: tuple[Any, ...], settings: tuple[Any, ...]
    ) -> Callable[..., Any]:
        def run(*leaves: Any) -> Any:
            return function(env, *jax.tree.unflatten(tree, leaves))

        called = f"{function.__module__}.{function.__qualname__}"
        file = _folder() / f"{called}-{_name(env, tree, kinds, settings)}"
        if (exported := _load(file)) is None:
            exported = export.export(jax.jit(run))(*kinds)
            _save(file, exported.serialize())
        return fast_cpu.jit(exported.call)

    @functools.wraps(function)
    def call(env: Env, *arguments: Any) -> Any:
        leaves, tree = jax.tree.flatten(arguments)
        if _can_be_kept(env):
            kinds = tuple(jax.eval_shape(lambda *x: x, *leaves))
            with _TRACING:
                found = program(env, tree, kinds, _settings())
            return found(*leaves)
        with _TRACING:
            jitted.lower(env, *arguments)  # which the call then finds done
        return jitted(env, *arguments)

    return call


def digest(env: Env) -> str:
    """SHA-256 of the scene and of how its robot may move, hexadecimal."""
    scene = np.empty(mujoco.mj_sizeModel(env.model), np.uint8)
    mujoco.mj_saveModel(env.model, None, scene)
    found = hashlib.sha256(scene.tobytes())
    for name, value in vars(env.robot).items():
        if name not in ("name", "body"):  # the body is in the scene
            found.update(np.asarray(value).tobytes())
    return found.hexdigest()


def _can_be_kept(env: Env) -> bool:
    folder = jax.config.jax_compilation_cache_dir
    return (
        folder is not None
        and "://" not in folder
        and env.physics.backend == "jax"
        and isinstance(env.renderer, RayRenderer)
        and _is_shipped(env.task)
    )


def _is_shipped(task: Task) -> bool:
    """Whether it is one of this package, whose source files say all of it."""
    name = f"{tasks.__name__}.{task.name}"
    found = importlib.util.find_spec(name)
    return found is not None and importlib.import_module(name).TASK is task


def _settings() -> tuple[Any, ...]:
    """Every setting of JAX as this thread has it."""
    every = sorted(jax.config.values.items())  # as they are outside of context managers
    return tuple((name, getattr(jax.config, name, value)) for name, value in every)


def _folder() -> Path:
    return Path(jax.config.jax_compilation_cache_dir) / "traced"


def _name(env: Env, tree: Any, kinds: tuple[Any, ...], settings: tuple[Any, ...]) -> str:
    """All that the program depends on, as a short text."""
    facts = [
        digest(env),
        env.task.name,
        (env.num_envs, env.image_size, env.antialias),
        (env.control_dt, env.actions, env.distractors, env.reward, env.discount),
        (tree, kinds, settings, jax.default_backend()),
        [importlib.metadata.version(name) for name in _VERSIONED],
        _sources(),
    ]
    return hashlib.sha256(repr(facts).encode()).hexdigest()


@functools.cache
def _sources() -> str:
    """SHA-256 of this package's source files, hexadecimal."""
    found, package = hashlib.sha256(), Path(__file__).parents[1]
    for file in sorted(package.rglob("*.py")):
        found.update(f"{file.relative_to(package)}\n".encode() + file.read_bytes())
    return found.hexdigest()


def _load(file: Path) -> export.Exported | None:
    """What was saved; None if there is nothing, or nothing that can be read."""
    try:
        data = bytearray(file.read_bytes())
    except OSError:
        return None
    checksum, program = data[:_CHECKSUM], data[_CHECKSUM:]
    return export.deserialize(program) if _checksum(program) == checksum else None


def _save(file: Path, program: bytearray) -> None:
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(file, _checksum(program) + program)
    except OSError as error:  # as JAX's cache does
        warnings.warn(f"a traced program could not be kept: {error}", stacklevel=2)


def _checksum(program: bytearray) -> bytes:
    return hashlib.sha256(program).digest()
