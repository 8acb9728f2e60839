"""The policies of a server: runs, a checkpoint or exported policies of one robot."""

import dataclasses
import itertools
import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from lorasp_jax.extras.serving.exported import ExportedPolicy, PolicyInterface, build_row
from lorasp_jax.extras.serving.policies import CompiledPolicy
from lorasp_jax.extras.serving.requests import PolicySpec, Request

_log = logging.getLogger(__name__)


class ServedPolicies:
    """Policies of one robot by adapter name.

    The noise of the flow depends only on the server's seed and on the numbers of the connection and
    of the request on it, so the n-th connection to a server can be repeated exactly. Neither a
    reset nor a new connection starts the noise again: an unlucky draw would be that of every
    episode.

    Attributes:
        spec: what requests must have, and what is returned.
        metadata: what the first policy's run says of its robot.
        instructions: adapters that a request may choose, the default first, and the instructions
            that each was trained with.
        sizes: batch sizes, ascending.
    """

    def __init__(
        self,
        policies: Mapping[str, CompiledPolicy | ExportedPolicy],
        *,
        prompt: str = "",
        seed: int = 0,
        execution: str = "naive",
    ) -> None:
        """Check that the policies fit; `warm_up` compiles.

        Args:
            policies: by adapter name; the first is the default.
            prompt: the instruction of requests that have none; "" selects the only instruction that
                the policy was trained with, if there is just one.
            seed: of the flow's noise.
            execution: "naive", or "trained" or "guided" to continue chunks, see docs/latency.md.
                Exported policies cannot be guided.

        Raises:
            ValueError: the policies need different observations or are of different robots, or
                cannot continue chunks as `execution` demands.
        """
        self._policies, self._prompt, self._warned = dict(policies), prompt, set()
        self.spec: PolicySpec = _common_spec(policies, execution)
        self.metadata: dict[str, Any] = dict(next(iter(policies.values())).description.metadata)
        self.instructions: dict[str, tuple[str, ...]] = {
            name: policy.instructions for name, policy in policies.items()
        }
        sizes = [set(policy.description.batch_sizes) for policy in policies.values()]
        self.sizes: tuple[int, ...] = tuple(sorted(set.intersection(*sizes)))
        # The key is an argument, as a constant would make a program of its own for every seed.
        self._key = jax.random.key(seed)
        self._draw = jax.jit(jax.vmap(draw_noise, (None, 0, None)), static_argnums=2)

    def warm_up(self, say: Callable[[str], None] = lambda _: None) -> None:
        """Compile and run every program; `say` is told of each before it starts."""
        spec = self.spec
        picture = np.zeros((spec.image_size, spec.image_size, 3), np.uint8)
        images, state = dict.fromkeys(spec.cameras, picture), np.zeros(spec.state_dim, np.float32)
        self._warned = {*self._policies}  # not of these zeros
        programs = list(itertools.product(self._policies, self.sizes))
        for number, (adapter, size) in enumerate(programs, start=1):
            say(f"compiling {adapter}, batch {size} ({number} of {len(programs)})")
            prompt = (self._prompt, *self.instructions[adapter], "press the button")
            request = Request(images, state, next(filter(None, prompt)), adapter)
            for _ in range(2):
                self.run(adapter, [self.prepare(request, (0, 0))] * size)
        self._warned = set()

    def prepare(self, request: Request, index: tuple[int, int]) -> dict[str, Any]:
        """Convert a request to a row of a batch.

        Args:
            request: a request.
            index: numbers of the connection and of the request on it, for the flow's noise.

        Raises:
            ValueError: there is no instruction, or the policy does not know it.
        """
        adapter, execution = request.adapter or next(iter(self._policies)), self.spec.execution
        known = self.instructions[adapter]
        prompt = request.prompt or self._prompt or (known[0] if len(known) == 1 else "")
        if not prompt:
            raise ValueError("the request must contain a prompt")
        self._warn(adapter, request.state)
        rest = None
        if execution != "naive":
            rest = np.zeros((0, self.spec.action_length), np.float32)
            if request.executed is not None and request.previous is not None:
                rest = request.previous[request.executed :]
        tokens = self._policies[adapter].tokens(prompt)
        row = build_row(self.spec, request.images, request.state, tokens, rest, request.delay)
        if rest is not None and execution == "guided":
            row["overlap"] = np.array(len(rest), np.int32)
        return {**row, "index": np.array(index, np.int32)}

    def _warn(self, adapter: str, state: np.ndarray) -> None:
        """Tell the log once of a state that no demonstration can have had."""
        bounds = getattr(self._policies[adapter], "plausible", None)  # exported ones have none
        if adapter in self._warned or bounds is None:
            return
        if (beyond := (state < bounds[0]) | (state > bounds[1])).any():
            self._warned.add(adapter)
            number = int(beyond.argmax())
            _log.warning(
                "number %d of a state is %g, but %g to %g would be plausible: check its unit",
                *(number, state[number], *bounds[:, number]),
            )

    def run(self, adapter: str, rows: Sequence[dict[str, Any]]) -> np.ndarray:
        """Return actions f32 `[B, C, J+1]`; B is one of `sizes`."""
        policy = self._policies[adapter]
        batch = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
        shape = (policy.description.chunk, policy.description.action_dim)
        noise = self._draw(self._key, batch.pop("index"), shape)
        return policy.run({**batch, "noise": noise})


def draw_noise(key: jax.Array, index: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Draw the noise of one request, f32 of a shape.

    Args:
        key: of the server.
        index: int32 `[2]`, numbers of the connection and of the request on it.
        shape: `(C, A)`.
    """
    connection, request = index
    key = jax.random.fold_in(jax.random.fold_in(key, connection), request)
    return jax.random.normal(key, shape)


def _common_spec(
    policies: Mapping[str, CompiledPolicy | ExportedPolicy], execution: str
) -> PolicySpec:
    """Return what all policies need; raise ValueError if they differ or cannot be executed so."""
    shared = [field.name for field in dataclasses.fields(PolicyInterface)]
    (first, expected), *_ = ((name, policy.description) for name, policy in policies.items())
    for name, policy in policies.items():
        for key in (*shared, "metadata"):
            a, b = getattr(expected, key), getattr(policy.description, key)
            if a != b:
                raise ValueError(
                    f"{first} and {name} cannot be served together: their {key} is {a} and {b}"
                )
        if execution == "trained" and not policy.description.continues:
            raise ValueError(
                f"{name} was not trained to continue chunks (--optim.rtc-max-delay): choose "
                "another --execution"
            )
    return PolicySpec(**{key: getattr(expected, key) for key in shared}, execution=execution)
