"""One set of base weights for the adapters of several policies.

A `Sampler` fuses adapters with the base, so that each adapter has its own copy of all weights. Here
the adapters' arrays and those of the base are separate arguments of one program, which fuses what
the flow steps use once per call. Adapters with equal methods and shapes share the program.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import native
from lorasp_jax.adapters.paths import by_path
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.inputs import OURS
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.sampling import Sampler
from lorasp_jax.models.transformer.depth import unstack
from lorasp_jax.peft import LoRA, Method

_STACK = "/blocks/"
"""In the name of an array that is stacked over layers."""
_TOWERS = ("vision/", "language/", "action/")
_RANKS = 16
_FACTORS = ("lora_a", "lora_b", "u", "v")
"""Names of the factors of a low-rank adapter."""


def sampling_config(config: BackboneConfig) -> BackboneConfig:
    """Return a config without what only training reads, or only a policy's processor."""
    return dataclasses.replace(config, remat="none", unroll=None, inputs=OURS)


class _Structure(NamedTuple):
    """How to rebuild a model from two lists of arrays."""

    graphdef: Any
    tree: Any
    names: tuple[str, ...]
    """Name of each array."""
    own: tuple[tuple[int, int | None] | None, ...]
    """Its place among the adapter's arrays, and its layer in a stacked one; None: the base's."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class SharedSampler:
    """Samples action chunks with one adapter of a `SharedBase`.

    Attributes:
        base: the base's arrays, which other samplers use too.
        own: the adapter's arrays, still stacked over layers: fewer arrays take less time to pass.
            They are in host memory unless the caller moves them.
    """

    base: list[jax.Array]
    own: list[Any]
    structure: _Structure = dataclasses.field(metadata={"static": True})
    config: BackboneConfig = dataclasses.field(metadata={"static": True})

    def sample_actions(self, key: jax.Array, obs: Observation, **options: Any) -> Any:
        """Sample action chunks; see `Sampler.sample_actions` for the arguments."""
        sampler = Sampler.from_model(self._model(), once=True)
        return sampler.sample_actions(key, obs, **options)

    def array(self, name: str) -> jax.Array:
        """Return an array of the model by its name."""
        pairs = zip(self.structure.names, self._leaves(), strict=True)
        return next(array for known, array in pairs if known == name)

    def _model(self) -> Any:
        leaves = self._leaves()
        return nnx.merge(self.structure.graphdef, jax.tree.unflatten(self.structure.tree, leaves))

    def _leaves(self) -> list[Any]:
        base, leaves = iter(self.base), []
        for place in self.structure.own:
            if place is None:
                leaves.append(next(base))
            else:
                array, layer = self.own[place[0]], place[1]
                leaves.append(array if layer is None else array[layer])
        return leaves


class SharedBase:
    """The weights of a base, each layer's apart, and what attaching adapters to them needs.

    Attributes:
        config: of the model.
        fingerprints: of the weights before they were quantized, to compare with an adapter's.
    """

    def __init__(self, model: Any, quantize: Callable[[Any], Any] = lambda model: model) -> None:
        """Take the weights of a model.

        Args:
            model: a backbone without adapters, none of whose arrays this object keeps.
            quantize: applied to the model, with or without adapters.
        """
        self.config: BackboneConfig = model.config
        self.fingerprints = native.base_fingerprints(model)
        self._quantize = quantize
        self._bare = nnx.eval_shape(lambda: self.config.create(nnx.Rngs(0)))
        self._shapes: dict[Any, Any] = {frozenset(): self._bare}
        self._structures: dict[Any, _Structure] = {}
        stacked = by_path(nnx.state(quantize(model)))
        self._arrays: dict[str, jax.Array] = {
            name: jnp.asarray(part)
            for whole, array in stacked.items()
            for name, part in _by_layer(whole, array).items()
        }

    def matches(self, fingerprints: Mapping[str, str]) -> bool:
        """Whether an adapter with these fingerprints was trained on this base."""
        common = self.fingerprints.keys() & fingerprints.keys()
        same = all(self.fingerprints[name] == fingerprints[name] for name in common)
        return bool(common) and same

    def read(self, folder: Any, *, any_base: bool = False) -> SharedSampler:
        """Attach the adapters of a folder; errors are those of `native.read_adapters`."""
        return self.attach(
            *native.read_adapters(folder, self._adapted, self.fingerprints, any_base=any_base)
        )

    def attach(
        self, methods: Mapping[str, Method], arrays: Mapping[str, np.ndarray]
    ) -> SharedSampler:
        """Return a sampler for an adapter.

        Args:
            methods: of each adapted path, as from `adaptation.methods`.
            arrays: the adapter's, by name; stacked layers have leading axes. One with the name of
                an array of the base replaces it.
        """
        methods, arrays = _common_ranks(methods, arrays)
        arrays = self._rounded(methods, arrays)
        structure = self._structure(methods, arrays)
        pairs = zip(structure.names, structure.own, strict=True)
        base = [self._arrays[name] for name, place in pairs if place is None]
        return SharedSampler(base, [*arrays.values()], structure, self.config)

    def attach_with(self, adapt: Callable[[Any], Any]) -> SharedSampler:
        """Return a sampler for what a function adds to a model with the base's shapes.

        The model's values are zeros that take no memory.
        """
        graphdef, shapes = nnx.split(self._bare)
        zeros = lambda x: np.broadcast_to(np.zeros((), x.dtype), x.shape)  # noqa: E731
        bare = nnx.merge(graphdef, jax.tree.map(zeros, shapes))
        return self.attach_model(adapt(bare), bare)

    def attach_model(self, model: Any, bare: Any) -> SharedSampler:
        """Return a sampler for a model that was adapted from `bare`, from which this base is."""
        base, arrays = (by_path(nnx.state(each)) for each in (bare, model))
        own = {n: np.asarray(a) for n, a in arrays.items() if base.get(n) is not a}
        return self.attach(adaptation.methods(model), own)

    def _rounded(
        self, methods: Mapping[str, Method], arrays: Mapping[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Round the factors of low-rank adapters to the dtype in which a sampler multiplies them.

        That of layers outside the towers is fp32.
        """
        names = {
            name
            for path, method in methods.items()
            for name in arrays
            if name.startswith(f"{path}/adapter/")
            and path.startswith(_TOWERS)
            and name.rpartition("/")[2] in _FACTORS
            and method.is_low_rank_sum
            and not method.down_in_fp32
        }
        dtype = jnp.dtype(self.config.dtype)
        return {n: a.astype(dtype) if n in names else a for n, a in arrays.items()}

    def _adapted(self, methods: Mapping[str, Method]) -> Any:
        """Return the shapes of the adapted model."""
        key = frozenset(methods.items())
        if key not in self._shapes:
            self._shapes[key] = native.abstract_adapted(self._bare, methods)
        return self._shapes[key]

    def _structure(
        self, methods: Mapping[str, Method], arrays: Mapping[str, np.ndarray]
    ) -> _Structure:
        """Return the structure of the adapted model, the same object for equal adapters."""
        key = frozenset(methods.items()), tuple(arrays)
        if key not in self._structures:
            graphdef, state = nnx.split(self._adapted(methods))
            prepare = lambda state: unstacked(self._quantize(nnx.merge(graphdef, state)))  # noqa: E731
            graphdef, state = nnx.split(nnx.eval_shape(prepare, state))
            names = tuple(by_path(state))
            places: dict[str, tuple[int, int | None]] = {}
            for k, (name, array) in enumerate(arrays.items()):
                parts = _by_layer(name, array)
                stacked = [*parts] != [name]
                places |= {n: (k, i if stacked else None) for i, n in enumerate(parts)}
            own = tuple(map(places.get, names))
            self._structures[key] = _Structure(graphdef, jax.tree.structure(state), names, own)
        return self._structures[key]


def _common_ranks(
    methods: Mapping[str, Method], arrays: Mapping[str, np.ndarray]
) -> tuple[dict[str, Method], dict[str, np.ndarray]]:
    """Return LoRAs as ones of scale 1 whose rank is a multiple of `_RANKS`, padded with zeros.

    Adapters that differ in these, or in settings of training, so share programs.
    """
    methods, arrays = dict(methods), dict(arrays)
    for path, method in methods.items():
        if type(method) is LoRA:
            down, up = f"{path}/adapter/lora_a", f"{path}/adapter/lora_b"
            rank = arrays[down].shape[-1]
            widen = lambda a, more=-rank % _RANKS: np.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, more)])  # noqa: E731
            arrays[down] = widen(arrays[down])
            scaled = arrays[up] * np.asarray(method.scale, arrays[up].dtype)
            arrays[up] = widen(scaled.swapaxes(-1, -2)).swapaxes(-1, -2)
            methods[path] = LoRA(arrays[down].shape[-1], alpha=arrays[down].shape[-1])
    return methods, arrays


def unstacked(model: Any) -> Any:
    """Return a backbone whose towers have a list of blocks."""
    model = nnx.merge(*nnx.split(model))
    for tower in (model.vision, model.language, model.action):
        tower.blocks = unstack(tower.blocks)
    return model


def _by_layer(name: str, array: Any) -> dict[str, Any]:
    """Split an array that is stacked over layers, and name each part as `unstacked` does."""
    if _STACK not in name:
        return {name: array}
    return {name.replace(_STACK, f"{_STACK}{i}/", 1): array[i] for i in range(len(array))}
