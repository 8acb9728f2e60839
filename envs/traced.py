"""Cache traced programs in files, in addition to JAX's cache of compiled programs.

JAX has to trace a program before it can look it up, and tracing MJX takes 6 to 8 s per scene
(measured). Reading a traced program from a file takes 0.2 s. The cache key covers the scene, all
source files of the program, all settings of JAX and the package versions. A change to any of them
causes a new trace.
"""

import functools
import hashlib
import importlib
import importlib.metadata
import importlib.util
import threading
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import jax
import mujoco
import numpy as np
from jax import export

from envs import tasks
from envs.env import Env
from envs.rendering.renderer import RayRenderer
from envs.scene.randomization import Draw
from envs.state import Data, Poses, State
from envs.tasks import Task
from lorasp_jax.base import fast_cpu
from lorasp_jax.base.writing import write_bytes

for _node in (State, Data, Draw):
    export.register_pytree_node_serialization(
        _node,
        serialized_name=f"{_node.__module__}.{_node.__qualname__}",
        serialize_auxdata=lambda _: b"",
        deserialize_auxdata=lambda _: (),
    )
export.register_namedtuple_serialization(Poses, serialized_name=f"{Poses.__module__}.Poses")

# Python can only trace one program at a time. With this lock, the first program compiles and runs
# while the second is traced. Without it, none would start before the last is traced.
_TRACING = threading.Lock()
_VERSIONED = ("jax", "jaxlib", "mujoco", "mujoco-mjx")
_CHECKSUM = hashlib.sha256().digest_size  # bytes at the start of a file


class cached:
    """Apply `jax.jit(..., static_argnums=0)`, tracing once for all processes on a machine.

    Programs are cached only if JAX's compilation cache is a local folder, environment and task come
    with this package, and every argument is on one of JAX's default devices. Programs that use Warp
    are not cached, since they contain memory addresses. The result is thread-safe, but cannot be
    vmapped.
    """

    def __init__(self, function: Callable[..., Any], files: Sequence[str] = ()) -> None:
        """Create the program.

        Args:
            function: a function that takes an `Env` and pytrees of arrays, and returns arrays in
                `State`, `Poses`, dicts, lists and tuples.
            files: source files outside this package on which the program depends.
        """
        functools.update_wrapper(self, function)
        self._function, self._sources = function, _sources(tuple(files))
        self._jitted = fast_cpu.jit(function, static_argnums=0)
        self._traced: WeakKeyDictionary[Env, set[Any]] = WeakKeyDictionary()
        self._exported = functools.lru_cache(maxsize=32)(self._load_or_trace)

    def __call__(self, env: Env, *arguments: Any) -> Any:
        """Run the program."""
        leaves, tree = jax.tree.flatten(arguments)
        key = tree, tuple(map(_kind, leaves)), _settings()
        if _is_cacheable(env, leaves):
            with _TRACING:
                run = self._exported(env, *key)
            return run(*leaves)
        with _TRACING:
            known = self._traced.setdefault(env, set())
            if key not in known:
                self._jitted.lower(env, *arguments)  # the call below reuses this trace
                known.add(key)
        return self._jitted(env, *arguments)

    def lower(self, env: Env, *arguments: Any) -> jax.stages.Lowered:
        """Trace and lower the program for arrays or shapes, like `jax.jit(...).lower`."""
        leaves, tree = jax.tree.flatten(arguments)
        with _TRACING:
            if _is_cacheable(env, leaves):
                run = self._exported(env, tree, tuple(map(_kind, leaves)), _settings())
                return run.lower(*leaves)
            return self._jitted.lower(env, *arguments)

    def _load_or_trace(self, *key: Any) -> Callable[..., Any]:
        exported = _load_or_trace(self._function, self._sources, *key)

        @functools.wraps(self._function)  # programs are named after functions
        def call_exported(*leaves: Any) -> Any:
            return exported.call(*leaves)

        return fast_cpu.jit(call_exported)


def _load_or_trace(
    function: Callable[..., Any],
    sources: str,
    env: Env,
    tree: Any,
    kinds: tuple[Any, ...],
    settings: tuple[Any, ...],
) -> export.Exported:
    """Return the program that takes the leaves of the arguments, of these shapes and types."""
    name = f"{function.__module__}.{function.__qualname__}"
    file = _folder() / f"{name}-{_key(env, tree, kinds, settings, sources)}"
    if (exported := _load(file)) is None:

        def run(*leaves: Any) -> Any:
            return function(env, *jax.tree.unflatten(tree, leaves))

        exported = export.export(jax.jit(run))(*kinds)
        _save(file, exported.serialize())
    return exported


def _kind(leaf: Any) -> jax.ShapeDtypeStruct:
    """Return the shape and type of an array or number."""
    kind = jax.typeof(leaf)
    return jax.ShapeDtypeStruct(kind.shape, kind.dtype, weak_type=kind.weak_type)


def _is_default_device() -> bool:
    """Return whether new arrays go to a device of JAX's default platform, for which JAX exports."""
    device = jax.config.jax_default_device
    return device is None or getattr(device, "platform", device) == jax.devices()[0].platform


def _is_on_default_device(leaf: Any) -> bool:
    """Return whether a leaf is a number, traced, or on one device of the default platform.

    A shape without a sharding counts as such a leaf.
    """
    sharding = None if isinstance(leaf, jax.core.Tracer) else getattr(leaf, "sharding", None)
    if sharding is None:
        return True
    platforms = [device.platform for device in sharding.device_set]
    return platforms == [jax.devices()[0].platform]


def digest(env: Env) -> str:
    """Compute the hexadecimal SHA-256 of the scene and the robot's kinematics and limits."""
    scene = np.empty(mujoco.mj_sizeModel(env.model), np.uint8)
    mujoco.mj_saveModel(env.model, None, scene)
    digest = hashlib.sha256(scene.tobytes())
    for name, value in vars(env.robot).items():
        if name not in ("name", "body"):  # the body is in the scene
            digest.update(np.asarray(value).tobytes())
    return digest.hexdigest()


def _is_cacheable(env: Env, leaves: Sequence[Any] = ()) -> bool:
    folder = jax.config.jax_compilation_cache_dir
    return (
        _is_default_device()
        and all(map(_is_on_default_device, leaves))
        and folder is not None
        and "://" not in folder
        and type(env) is Env  # a subclass may have other programs
        and env.physics.backend == "jax"
        and env.physics.model is env.model
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
        (env.num_envs, env.image_size, env.antialias, _drawn(env)),
        (env.control_dt, env.actions, env.distractors, env.reward, env.discount),
        (tree, kinds, settings, jax.default_backend()),
        [importlib.metadata.version(name) for name in _VERSIONED],
        sources,
    ]
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def _drawn(env: Env) -> tuple[Any, ...]:
    """Return what the renderer draws, which may differ from the scene."""
    leaves, tree = jax.tree.flatten(env.render_model)
    arrays = [np.asarray(leaf) for leaf in leaves]
    return str(tree), [(x.dtype.str, x.shape, x.tobytes().hex()) for x in arrays]


@functools.cache
def _sources(files: tuple[str, ...]) -> str:
    """Compute the hexadecimal SHA-256 of this package's and other source files."""
    digest, package = hashlib.sha256(), Path(__file__).parent
    for file in [*sorted(package.rglob("*.py")), *map(Path, files)]:
        name = file.relative_to(package) if file.is_relative_to(package) else file.name
        digest.update(f"{name}\n".encode() + file.read_bytes())
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
