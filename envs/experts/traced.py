"""Cache traced programs in files, in addition to JAX's cache of compiled programs.

JAX has to trace a program before it can look it up, and tracing MJX takes 6 to 8 s per scene
(measured). Reading a traced program from a file takes 0.2 s. The cache key covers the scene, all
source files of this package, all settings of JAX and the package versions. A change to any of them
causes a new trace.
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

# Python can only trace one program at a time. With this lock, the first program compiles and runs
# while the second is traced. Without it, none would start before the last is traced.
_TRACING = threading.Lock()
_VERSIONED = ("jax", "jaxlib", "mujoco", "mujoco-mjx")
_CHECKSUM = hashlib.sha256().digest_size  # bytes at the start of a file


def cached(
    function: Callable[..., Any], sources: Callable[[], str] | None = None
) -> Callable[..., Any]:
    """Apply `jax.jit(..., static_argnums=0)`, tracing once for all processes on a machine.

    Programs are cached only if JAX's compilation cache is a local folder and the task comes with
    this package. Programs that use Warp are not cached, since they contain memory addresses. The
    result is thread-safe, but cannot be vmapped.

    Args:
        function: a function in this package that takes an `Env` and pytrees of arrays, and returns
            arrays in dicts, lists and tuples.
        sources: returns a digest of the program's source files; default: those of this package.
    """
    jitted = fast_cpu.jit(function, static_argnums=0)

    @functools.lru_cache(maxsize=32)
    def program(
        env: Env, tree: Any, kinds: tuple[Any, ...], settings: tuple[Any, ...]
    ) -> Callable[..., Any]:
        def run(*leaves: Any) -> Any:
            return function(env, *jax.tree.unflatten(tree, leaves))

        name = f"{function.__module__}.{function.__qualname__}"
        file = _folder() / f"{name}-{_key(env, tree, kinds, settings, (sources or _sources)())}"
        if (exported := _load(file)) is None:
            exported = export.export(jax.jit(run))(*kinds)
            _save(file, exported.serialize())
        return fast_cpu.jit(exported.call)

    @functools.wraps(function)
    def call(env: Env, *arguments: Any) -> Any:
        leaves, tree = jax.tree.flatten(arguments)
        if _is_cacheable(env):
            kinds = tuple(jax.eval_shape(lambda *x: x, *leaves))
            with _TRACING:
                run = program(env, tree, kinds, _settings())
            return run(*leaves)
        with _TRACING:
            jitted.lower(env, *arguments)  # the call below reuses this trace
        return jitted(env, *arguments)

    return call


def digest(env: Env) -> str:
    """Compute the hexadecimal SHA-256 of the scene and the robot's kinematics and limits."""
    scene = np.empty(mujoco.mj_sizeModel(env.model), np.uint8)
    mujoco.mj_saveModel(env.model, None, scene)
    digest = hashlib.sha256(scene.tobytes())
    for name, value in vars(env.robot).items():
        if name not in ("name", "body"):  # the body is in the scene
            digest.update(np.asarray(value).tobytes())
    return digest.hexdigest()


def _is_cacheable(env: Env) -> bool:
    folder = jax.config.jax_compilation_cache_dir
    return (
        folder is not None
        and "://" not in folder
        and env.physics.backend == "jax"
        and isinstance(env.renderer, RayRenderer)
        and _is_shipped(env.task)
    )


def _is_shipped(task: Task) -> bool:
    """Return whether the task comes with this package, so that source files define it fully."""
    name = f"{tasks.__name__}.{task.name}"
    spec = importlib.util.find_spec(name)
    return spec is not None and importlib.import_module(name).TASK is task


def _settings() -> tuple[Any, ...]:
    """Return all settings of JAX as this thread sees them."""
    settings = sorted(jax.config.values.items())  # global values, without those of context managers
    return tuple((name, getattr(jax.config, name, value)) for name, value in settings)


def _folder() -> Path:
    return Path(jax.config.jax_compilation_cache_dir) / "traced"


def _key(
    env: Env, tree: Any, kinds: tuple[Any, ...], settings: tuple[Any, ...], sources: str
) -> str:
    parts = [
        digest(env),
        env.task.name,
        (env.num_envs, env.image_size, env.antialias),
        (env.control_dt, env.actions, env.distractors, env.reward, env.discount),
        (tree, kinds, settings, jax.default_backend()),
        [importlib.metadata.version(name) for name in _VERSIONED],
        sources,
    ]
    return hashlib.sha256(repr(parts).encode()).hexdigest()


@functools.cache
def _sources() -> str:
    """Compute the hexadecimal SHA-256 of this package's source files."""
    digest, package = hashlib.sha256(), Path(__file__).parents[1]
    for file in sorted(package.rglob("*.py")):
        digest.update(f"{file.relative_to(package)}\n".encode() + file.read_bytes())
    return digest.hexdigest()


def _load(file: Path) -> export.Exported | None:
    """Load a cached program; return None if it is missing or damaged."""
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
    except OSError as error:  # warn, as JAX's cache does
        warnings.warn(f"cannot cache a traced program: {error}", stacklevel=2)


def _checksum(program: bytearray) -> bytes:
    return hashlib.sha256(program).digest()
