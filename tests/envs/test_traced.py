"""Traced programs are cached between processes."""

import dataclasses
import gc
import itertools
import shutil
import threading
import time
import types
import weakref
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs import Randomization, robots
from envs import traced as programs
from envs.scene.randomization import Draw
from envs.state import Poses


@pytest.fixture
def cache(tmp_path):
    """An empty compilation cache."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "cache"))
    yield tmp_path / "cache"
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.fixture(scope="module")
def env():
    return envs.make("press", num_envs=3, image_size=8, backend="jax")


class Drawn:
    """A program for `programs.cached` that counts its traces."""

    def __init__(self):
        self.traced, self.__name__, self.__qualname__ = 0, "drawn", "drawn"

    def __call__(self, env, key, scale, ranges=None):
        self.traced += 1
        word = jax.random.key_data(key)[-1].astype(jnp.float32)  # compiles faster than a draw
        noise = jnp.broadcast_to(scale * word, (env.num_envs, env.num_joints))
        total = sum(map(jnp.sum, jax.tree.leaves(ranges)))
        return {"noise": noise}, jnp.full(env.num_envs, total)


def new_process(env, *arguments, files=()):
    """Return the results in a new process, and whether it traced."""
    function = Drawn()
    return programs.cached(function, files)(env, *arguments), bool(function.traced)


KEY = jax.random.key(5)


def test_another_process_does_not_trace(env, cache):
    plain = jax.jit(Drawn(), static_argnums=0)(env, KEY, 0.5)
    first, traced = new_process(env, KEY, 0.5)
    second, again = new_process(env, KEY, 0.25)
    assert (traced, again) == (True, False)
    np.testing.assert_array_equal(first[0]["noise"], plain[0]["noise"])
    np.testing.assert_array_equal(second[0]["noise"], plain[0]["noise"] / 2)
    np.testing.assert_array_equal(first[1], plain[1])


def test_states_are_read_back(env, cache):
    count = [0]

    def start(env, key, ranges):
        count[0] += 1
        shapes, number = jax.eval_shape(env.reset, key, ranges), itertools.count()
        state = jax.tree.map(lambda x: jnp.full(x.shape, next(number), x.dtype), shapes)
        return state, {"poses": Poses.of(state.data)}

    arguments = env, KEY, Randomization.typical()
    first, second = (programs.cached(start)(*arguments) for _ in range(2))
    assert count == [1]
    assert isinstance(second[0].info["draw"], Draw)
    assert jax.tree.structure(first) == jax.tree.structure(second)
    jax.tree.map(np.testing.assert_array_equal, first, second)


def test_arrays_on_several_devices_are_not_cached(env, cache):
    mesh = jax.sharding.Mesh(jax.devices()[:2], "x")
    everywhere = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
    function = Drawn()
    call = programs.cached(function)
    for _ in range(2):
        results = call(env, jax.device_put(KEY, everywhere), 0.5)
    assert function.traced == 1
    assert len(results[1].sharding.device_set) == 2
    assert not (cache / "traced").exists()


def test_a_changed_picture_is_traced(env, cache):
    model = env.render_model
    black = dataclasses.replace(model.appearance, rgba=np.zeros_like(model.appearance.rgba))
    renderer = dataclasses.replace(env.renderer, model=dataclasses.replace(model, appearance=black))
    new_process(env, KEY, 0.5)
    assert new_process(dataclasses.replace(env, renderer=renderer), KEY, 0.5)[1]


def test_another_platform_is_not_cached(env, cache, monkeypatch):
    assert programs._is_default_device()
    for device in jax.devices()[1], "cpu":
        with jax.default_device(device):
            assert programs._is_default_device()
    with monkeypatch.context() as patch:
        gpu = types.SimpleNamespace(platform="gpu")
        patch.setattr(programs.jax, "devices", lambda: [gpu])
        assert not programs._is_on_default_device(KEY)
        with jax.default_device("cpu"):
            assert not programs._is_default_device()
    assert programs._is_on_default_device(KEY)
    assert programs._is_on_default_device(np.ones(3))
    mesh = jax.make_mesh((2,), ("d",), devices=jax.devices()[:2])
    shards = jax.sharding.NamedSharding(mesh, jax.P())
    assert not programs._is_on_default_device(jax.ShapeDtypeStruct((3,), int, sharding=shards))


def test_a_program_compiles_from_shapes(env, cache):
    call = programs.cached(Drawn())
    place = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    key = jax.device_put(KEY, place)
    shape = jax.ShapeDtypeStruct(key.shape, key.dtype, sharding=place)
    lowered = call.lower(env, shape, 0.5)
    noise, _ = lowered.out_info
    assert (noise["noise"].shape, noise["noise"].dtype) == ((3, env.num_joints), np.float32)
    expected = jax.tree.leaves(call(env, key, 0.5))
    found = lowered.compile()(key, 0.5)
    jax.tree.map(np.testing.assert_array_equal, jax.tree.leaves(found), expected)


def test_a_program_is_part_of_another(env, cache):
    call = programs.cached(Drawn())
    inside = jax.jit(lambda key: call(env, key, 0.5)[0]["noise"])(KEY)
    np.testing.assert_array_equal(inside, call(env, KEY, 0.5)[0]["noise"])


def test_environments_are_freed():
    class Room:
        pass

    room, call = Room(), programs.cached(lambda env, key: {"key": jax.random.normal(key)})
    call(room, KEY)
    reference = weakref.ref(room)
    del room
    jax.clear_caches()
    gc.collect()
    assert reference() is None


def test_a_process_asks_once(env, cache):
    function = Drawn()
    call = programs.cached(function)
    call(env, KEY, 0.5)
    shutil.rmtree(cache)  # asked again, it would be traced again
    call(env, jax.random.key(1), 1.0)
    assert function.traced == 1


@pytest.mark.parametrize(
    "change",
    [
        pytest.param({"num_envs": 4}, marks=pytest.mark.slow),
        {"image_size": 9},
        {"antialias": 2},
        {"control_dt": 0.2},
        {"distractors": 1},
        pytest.param({"actions": "delta_joint"}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_another_environment_is_traced(env, cache, change):
    new_process(env, KEY, 0.5)
    options = {"num_envs": 3, "image_size": 8, "backend": "jax"} | change
    results, traced = new_process(envs.make("press", **options), KEY, 0.5)
    assert traced
    assert len(results[1]) == options["num_envs"]


@pytest.mark.slow
def test_another_scene_is_traced(env, cache):
    new_process(env, KEY, 0.5)
    options = {"num_envs": 3, "image_size": 8, "backend": "jax"}
    assert new_process(envs.make("pick_place", **options), KEY, 0.5)[1]
    assert new_process(envs.make("press", "panda", **options), KEY, 0.5)[1]
    piper = robots.piper.ROBOT
    slower = types.SimpleNamespace(**vars(piper) | {"speed": piper.speed / 2})
    changed = types.SimpleNamespace(model=env.model, robot=slower)
    same = types.SimpleNamespace(model=env.model, robot=piper)
    assert programs.digest(changed) != programs.digest(same) == programs.digest(env)


def test_other_arguments_are_traced(env, cache):
    new_process(env, KEY, 0.5)
    assert new_process(env, KEY, 0.5, Randomization.typical())[1]
    assert not new_process(env, KEY, 0.5, Randomization(mass=(1.0, 2.0)))[1]  # a value, no shape
    assert new_process(env, KEY, jnp.ones(env.num_joints))[1]


@pytest.mark.slow
def test_another_setting_is_traced(env, cache):
    new_process(env, KEY, 0.5)
    with jax.default_matmul_precision("float32"):  # of this thread alone
        assert new_process(env, KEY, 0.5)[1]
    assert not new_process(env, KEY, 0.5)[1]
    before = jax.config.jax_default_matmul_precision
    try:
        jax.config.update("jax_default_matmul_precision", "tensorfloat32")
        assert new_process(env, KEY, 0.5)[1]
    finally:
        jax.config.update("jax_default_matmul_precision", before)


def test_a_changed_source_file_is_traced(env, cache, tmp_path):
    file = tmp_path / "program.py"
    file.write_text("before")
    assert new_process(env, KEY, 0.5, files=[str(file)])[1]
    assert not new_process(env, KEY, 0.5, files=[str(file)])[1]
    early = Drawn()
    call = programs.cached(early, [str(file)])  # imported before the change
    file.write_text("after")
    programs._sources.cache_clear()  # read once per process
    call(env, KEY, 0.5)
    assert not early.traced
    assert new_process(env, KEY, 0.5, files=[str(file)])[1]


def test_the_sources_are_those_of_this_package(tmp_path, monkeypatch):
    """An installed package has thousands of others beside it, and editors leave dead links."""
    read, own = set(), Path(envs.__file__).parent
    monkeypatch.setattr(Path, "read_bytes", lambda path: bytes(read.add(path) or 0))
    programs._sources.__wrapped__((str(tmp_path / "program.py"),))
    assert read == {*own.rglob("*.py"), tmp_path / "program.py"}


@pytest.mark.parametrize(
    "damage", [lambda b: b[:-9], lambda b: b[:99] + b"?" + b[100:], lambda _: b""]
)
def test_a_damaged_program_is_retraced(env, cache, damage):
    (good, _), _ = new_process(env, KEY, 0.5)
    (file,) = (cache / "traced").iterdir()
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    (results, _), traced = new_process(env, KEY, 0.5)
    assert traced
    np.testing.assert_array_equal(results["noise"], good["noise"])
    assert not new_process(env, KEY, 0.5)[1]


def test_nothing_is_cached_without_a_cache_folder(env, cache):
    jax.config.update("jax_compilation_cache_dir", None)
    assert new_process(env, KEY, 0.5)[1]
    assert new_process(env, KEY, 0.5)[1]
    assert not cache.exists()


def test_only_programs_that_source_files_define_are_cached(env, cache):
    def changed(**changes):
        return dataclasses.replace(env, **changes)

    class Other(type(env)):
        pass

    other = Other(**{f.name: getattr(env, f.name) for f in dataclasses.fields(env)})
    longer = changed(task=dataclasses.replace(env.task, time_limit=2 * env.task.time_limit))
    unknown = changed(task=dataclasses.replace(env.task, name="a_new_one"))
    warp = changed(physics=types.SimpleNamespace(backend="warp", model=env.model))
    assert programs._is_cacheable(env)
    assert not any(map(programs._is_cacheable, (other, longer, unknown, warp)))


def test_a_failing_write_warns(env, cache):
    cache.mkdir()
    (cache / "traced").write_text("a file where the folder should be")
    with pytest.warns(UserWarning, match="cannot cache a traced program"):
        (results, _), _ = new_process(env, KEY, 0.5)
    assert np.isfinite(results["noise"]).all()


def test_programs_are_traced_in_turn(env, cache):
    inside, most = [0], [0]

    def program(number):
        def slow(env, key):
            inside[0] += 1
            most[0] = max(most[0], inside[0])
            time.sleep(0.05)
            inside[0] -= 1
            return {"key": jnp.full(number, 0)}

        return programs.cached(slow)

    threads = [threading.Thread(target=program(n + 1), args=(env, KEY)) for n in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1]
