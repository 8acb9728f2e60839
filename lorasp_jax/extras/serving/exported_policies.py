"""Exported policies in the form that the server runs, one per adapter."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from lorasp_jax.extras.serving.exported import ExportedPolicy
from lorasp_jax.extras.serving.noise import draw
from lorasp_jax.extras.serving.requests import PolicySpec, Request, choose_prompt, common_spec


class ExportedPolicies:
    """Exported policies of one robot by adapter name. See `BatchPolicy`."""

    def __init__(
        self,
        policies: Mapping[str, ExportedPolicy],
        *,
        prompt: str = "",
        seed: int = 0,
        execution: str = "naive",
    ) -> None:
        """Check that the policies fit; `warm_up` compiles.

        Args:
            policies: by adapter name; the first is the default.
            prompt: the instruction of requests that have none, as for `CompiledPolicies`.
            seed: of the flow's noise, which is the same as that of `CompiledPolicies`.
            execution: "naive", or "trained" to continue chunks.

        Raises:
            ValueError: the policies need different observations, or cannot continue chunks as
                `execution` demands.
        """
        self._policies = dict(policies)
        self._specs = {name: _spec(policy) for name, policy in policies.items()}
        self.spec: PolicySpec = dataclasses.replace(common_spec(self._specs), execution=execution)
        self.metadata: dict[str, Any] = _common_metadata(policies)
        _check_execution(policies, execution)
        self._prompt, key = prompt, jax.random.key(seed)
        sizes = [set(policy.description.batch_sizes) for policy in policies.values()]
        self.sizes: tuple[int, ...] = tuple(sorted(set.intersection(*sizes)))
        self._noise = jax.jit(functools.partial(draw, key), static_argnames="shape")

    @property
    def adapters(self) -> tuple[str, ...]:
        """Names of the policies; the first is the default."""
        return tuple(self._policies)

    @property
    def instructions(self) -> dict[str, tuple[str, ...]]:
        """The instructions that each policy was trained with."""
        return {name: spec.instructions for name, spec in self._specs.items()}

    def warm_up(self, progress: Callable[[str, int], None] = lambda *_: None) -> None:
        """Compile and run every program; `progress` is told of each before it starts."""
        picture = np.zeros((self.spec.image_size, self.spec.image_size, 3), np.uint8)
        images, state = dict.fromkeys(self.spec.cameras, picture), np.zeros(self.spec.state_dim)
        for adapter, size in itertools.product(self.adapters, self.sizes):
            progress(adapter, size)
            prompt = self._specs[adapter].instructions[0]
            request = Request(images, state.astype(np.float32), prompt, adapter, False, 0)
            self.run(adapter, [self.prepare(request, (0, 0))] * size)

    def prepare(self, request: Request, index: tuple[int, int]) -> dict[str, Any]:
        """Convert a request to a row of a batch.

        Raises:
            ValueError: there is no instruction, or the policy does not know it.
        """
        adapter = request.adapter or self.adapters[0]
        policy = self._policies[adapter]
        prompt = choose_prompt(request, self._prompt, self._specs[adapter])
        noise = np.asarray(self._noise(np.array(index), shape=policy.noise_shape))
        previous = None
        if self.spec.execution == "trained":
            previous = np.zeros((0, self.spec.state_dim), np.float32)
            if request.executed is not None and request.previous is not None:
                previous = request.previous[request.executed :]
        return policy.row(request.images, request.state, prompt, noise, previous, request.delay)

    def run(self, adapter: str, rows: Sequence[dict[str, Any]]) -> np.ndarray:
        """Return actions f32 `[B, C, J+1]`."""
        return self._policies[adapter].run(rows)


def _spec(policy: ExportedPolicy) -> PolicySpec:
    needs = policy.description
    return PolicySpec(
        cameras=tuple(needs.cameras),
        image_size=needs.image_size,
        state_dim=needs.state_dim,
        chunk=needs.chunk,
        masks_missing=needs.masks_missing,
        centred=needs.centred,
        antialias=needs.antialias,
        instructions=policy.instructions,
    )


def _common_metadata(policies: Mapping[str, ExportedPolicy]) -> dict[str, Any]:
    """Return the metadata of all policies; raise ValueError if they differ."""
    first, *others = (dict(policy.description.metadata) for policy in policies.values())
    for other in others:
        if other != first:
            raise ValueError(f"the policies must agree on their metadata, got {first} and {other}")
    return first


def _check_execution(policies: Mapping[str, ExportedPolicy], execution: str) -> None:
    """Raise ValueError if a policy cannot be executed like this."""
    if execution == "guided":
        raise ValueError("exported policies cannot be guided: use --execution naive or trained")
    for name, policy in policies.items():
        if execution == "trained" and not policy.description.continues:
            raise ValueError(
                f"{name} was not trained to continue chunks (--optim.rtc-max-delay): use "
                "--execution naive"
            )
