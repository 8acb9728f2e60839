"""Adapters on shared bases: loading them, and keeping the K last used on the device."""

import dataclasses
import functools
import sys
import threading
import weakref
from typing import Any

import jax
import numpy as np

from lorasp_jax import peft
from lorasp_jax.adapters.io import native
from lorasp_jax.models.shared_base import SharedBase, SharedSampler, sampling_config
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.base import quantized
from lorasp_jax.training.export import RecordedPolicy


class OnDevice:
    """Keeps the arrays of the last used adapters on the device; all are in host memory.

    Adapters are held weakly: one that was unloaded leaves the device once its last request has been
    answered.
    """

    def __init__(self, capacity: int | None = None) -> None:
        """Keep at most `capacity` adapters; None: all."""
        self.capacity = capacity
        self.loads = 0
        self._lock = threading.Lock()
        self._held: weakref.WeakKeyDictionary[SharedSampler, list[jax.Array]]
        self._held = weakref.WeakKeyDictionary()

    def __contains__(self, policy: Policy) -> bool:
        return policy.model in self._held

    def __call__(self, policy: Policy) -> Policy:
        """Return the policy with its adapter's arrays on the device."""
        model = policy.model
        if not isinstance(model, SharedSampler) or not model.own:
            return policy
        with self._lock:
            own = self._held.pop(model, None)
            if own is None:
                for oldest in [*self._held][: self._surplus()]:
                    self._held.pop(oldest, None)
                own = jax.device_put(model.own)
                self.loads += 1
            self._held[model] = own
        return dataclasses.replace(policy, model=dataclasses.replace(model, own=own))

    def _surplus(self) -> int:
        """Return how many adapters must make room for another."""
        return 0 if self.capacity is None else max(0, len(self._held) + 1 - self.capacity)


class Bases:
    """The bases of finished runs, each in memory once for all adapters trained on it."""

    def __init__(self, *, any_base: bool = False) -> None:
        """Start without a base; `any_base` accepts adapters of another, see `load_adapters`."""
        self._any_base = any_base
        self._bases: list[tuple[Any, str, SharedBase]] = []

    def sampler(self, recorded: RecordedPolicy, *, load: bool = True) -> SharedSampler:
        """Return a sampler for a run.

        Args:
            recorded: from the run's files.
            load: whether to load a base that no earlier run has.

        Raises:
            ValueError: the run trained its base or an actor of its noise, or splits kernels, its
                files are damaged, or it has another base than it records, or than those loaded if
                `load` is false.
        """
        folder = recorded.folder
        if recorded.is_full:
            raise ValueError(f"{folder} trained its base, so it cannot share one")
        if recorded.noise_actor:
            raise ValueError(f"{folder} has learned its noise: serve it on its own")
        description, kind = native.read_description(folder), recorded.quantized
        saved, digest = description["weights"], description["base"]
        if not saved and not self._any_base:
            raise ValueError(f"{folder} has no fingerprints of its base: --any-base accepts it")
        needed = sampling_config(recorded.config), kind
        fitting = [(d, base) for has, d, base in self._bases if has == needed]
        # Quantized kernels have no fingerprints of their own.
        known = [b for d, b in fitting if b.matches(saved) and (not kind or d == digest)]
        if self._any_base and not load:
            known = known or [base for _, base in fitting]
        if known:
            return known[0].read(folder, any_base=self._any_base)
        if not load:
            raise ValueError(
                f"{folder} was trained on another base than those of this server, or with another "
                "config: serve it on its own"
            )
        base = SharedBase(recorded.load_base(), functools.partial(quantized, kind=kind))
        self._bases.append((needed, digest, base))
        return base.read(folder, any_base=self._any_base)

    @staticmethod
    def can_share(run: str, base: str = "") -> bool:
        """Whether the adapters of a run can share its base; says so if they cannot."""
        recorded = RecordedPolicy.read(run, base=base)
        settings = {} if recorded.is_full else native.read_description(recorded.folder)["methods"]
        methods = map(peft.from_settings, settings.values())
        changes = recorded.is_full or any(method.splits_kernel for method in methods)
        if changes or recorded.noise_actor:
            why = "changes its base" if changes else "has learned its noise"
            print(f"{run} {why}, so it has a copy of its own", file=sys.stderr)
        return not (changes or recorded.noise_actor)


def is_shared(policy: Any) -> bool:
    """Whether a served policy has its weights from a shared base."""
    return isinstance(getattr(getattr(policy, "policy", None), "model", None), SharedSampler)


def embed(policy: Policy, ids: np.ndarray) -> np.ndarray:
    """Return the mean embedding f32 `[D]` of token ids in a shared base."""
    table = policy.model.array("language/embedding")
    return np.asarray(table[ids], np.float32).mean(axis=0)
