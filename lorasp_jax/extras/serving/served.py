"""The policies of a server: runs, a checkpoint or exported policies of one robot."""

import dataclasses
import functools
import itertools
import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from lorasp_jax.base.arguments import NAME
from lorasp_jax.extras.serving import routing
from lorasp_jax.extras.serving.adapters import embed, is_shared
from lorasp_jax.extras.serving.exported import (
    Description,
    ExportedPolicy,
    PolicyInterface,
    build_row,
)
from lorasp_jax.extras.serving.policies import CACHED_PROMPTS, Answer, CompiledPolicy
from lorasp_jax.extras.serving.requests import PolicySpec, Request
from lorasp_jax.training.export import DIMENSIONS

_log = logging.getLogger(__name__)


@dataclass(eq=False)
class Adapter:
    """A policy under the name by which requests choose it; requests keep theirs if it is replaced.

    Attributes:
        name: its name.
        policy: the policy.
        warned: whether the log was told of an absurd state.
    """

    name: str
    policy: CompiledPolicy | ExportedPolicy
    warned: bool = False

    def __str__(self) -> str:
        """Return the name."""
        return self.name


class ServedPolicies:
    """Policies of one robot by adapter name, which may change while requests are answered.

    The noise of the flow depends only on the server's seed and on the numbers of the connection and
    of the request on it, so the n-th connection to a server can be repeated exactly. Neither a
    reset nor a new connection starts the noise again: an unlucky draw would be that of every
    episode.

    Attributes:
        spec: what requests must have, and what is returned.
        sizes: batch sizes, ascending.
        routing: how requests without a name find their adapter, one of `routing.MODES`.
    """

    routing: str = "name"

    def __init__(
        self,
        policies: Mapping[str, CompiledPolicy | ExportedPolicy],
        *,
        prompt: str = "",
        seed: int = 0,
        execution: str = "naive",
        route: str = "name",
        load: Callable[[str], CompiledPolicy] | None = None,
    ) -> None:
        """Check that the policies fit; `warm_up` compiles.

        Args:
            policies: by adapter name; the first is the default.
            prompt: the instruction of requests that have none; "" selects the only instruction that
                the policy was trained with, if there is just one.
            seed: of the flow's noise.
            execution: "naive", or "trained" or "guided" to continue chunks, see docs/latency.md.
                Exported policies cannot be guided.
            route: one of `routing.MODES`; "nearest" needs policies on a `SharedBase`.
            load: loads another adapter from a path, for `put`; None: adapters do not change.

        Raises:
            ValueError: the policies need different observations or are of different robots, or
                cannot continue chunks as `execution` demands.
        """
        self._prompt, self._load = prompt, load
        self.routing = route
        self.spec: PolicySpec = common_spec(_descriptions(policies), execution)
        self._adapters = {name: Adapter(name, policy) for name, policy in policies.items()}
        self._default = next(iter(policies))
        if route != "name" and (doubtful := routing.shared(self.instructions)):
            text, names = next(iter(doubtful.items()))
            _log.warning(
                "several adapters have the same instructions (%d, such as %r of %s): requests with "
                "these must name the adapter",
                *(len(doubtful), text, " and ".join(names)),
            )
        self._change = threading.Lock()
        sizes = [set(policy.description.batch_sizes) for policy in policies.values()]
        self.sizes: tuple[int, ...] = tuple(sorted(set.intersection(*sizes)))
        # The key is an argument, as a constant would make a program of its own for every seed.
        self._key = jax.random.key(seed)
        self._draw = jax.jit(jax.vmap(draw_noise, (None, 0, None)), static_argnums=2)
        self._embed = functools.lru_cache(CACHED_PROMPTS)(self._embedding)

    @property
    def instructions(self) -> dict[str, tuple[str, ...]]:
        """Adapters that a request may choose, the default first, and their instructions."""
        return {name: each.policy.instructions for name, each in self._adapters.items()}

    @property
    def adapters(self) -> list[Adapter]:
        """The present adapters, the default first."""
        return [*self._adapters.values()]

    @property
    def metadata(self) -> dict[str, Any]:
        """What the runs say of their robot, and `DIMENSIONS` of each adapter that knows them."""
        said = {str(each): each.policy.description.metadata for each in self.adapters}
        own = {key: {n: x[key] for n, x in said.items() if key in x} for key in DIMENSIONS}
        return _of_robot(said[self._default]) | {key: x for key, x in own.items() if x}

    @property
    def denoise_steps(self) -> dict[str, int]:
        """Flow steps of each adapter."""
        return {str(each): each.policy.description.num_steps for each in self.adapters}

    @property
    def places(self) -> dict[str, str]:
        """Where the weights of each adapter are, in words."""
        on = "on the device"  # exported ones do not move
        return {name: getattr(each.policy, "where", on) for name, each in self._adapters.items()}

    def warm_up(self, say: Callable[[str], None] = lambda _: None) -> None:
        """Compile and run every program; `say` is told of each before it starts."""
        programs = [*itertools.product(self.adapters, self.sizes)]
        for number, (adapter, size) in enumerate(programs, start=1):
            say(f"compiling {adapter}, batch {size} ({number} of {len(programs)})")
            self._try_out(adapter, size)

    def _try_out(self, adapter: Adapter, size: int) -> None:
        """Run a batch twice, which compiles the program if no other adapter has the same."""
        spec = self.spec
        picture = np.zeros((spec.image_size, spec.image_size, 3), np.uint8)
        images, state = dict.fromkeys(spec.cameras, picture), np.zeros(spec.state_dim, np.float32)
        prompt = (self._prompt, *adapter.policy.instructions, "press the button")
        request = Request(images, state, next(filter(None, prompt)))
        for _ in range(2):
            self.run(adapter, [self._row(adapter, request, (0, 0))] * size)

    def put(self, name: str, path: str) -> None:
        """Load an adapter and serve it from the next batch on, in place of one of the same name.

        It is compiled and tried out first, while others answer.

        Raises:
            ValueError: adapters do not change, the name is unsuitable, or the adapter cannot be
                loaded or served with the others.
        """
        if self._load is None:
            raise ValueError(
                "the policies of this server have weights of their own: start it with several "
                "runs of one base, or with --adapters-on-device"
            )
        if not NAME.fullmatch(name):
            raise ValueError(f"name must match {NAME.pattern}, got {name[:80]!r}")
        with self._change:  # one at a time
            adapter, first = Adapter(name, self._load(path)), self._adapters[self._default]
            both = {f"the present {first.name}": first.policy, name: adapter.policy}
            common_spec(_descriptions(both), self.spec.execution)
            for size in self.sizes:
                self._try_out(adapter, size)
            self._adapters = self._adapters | {name: adapter}

    def remove(self, name: str) -> None:
        """Serve an adapter no longer; requests that chose it are still answered.

        Raises:
            ValueError: there is no such adapter, or it is the default.
        """
        with self._change:
            if name == self._default:
                raise ValueError(f"{name} answers requests that name no adapter: replace it")
            self._find(name)
            self._adapters = {n: each for n, each in self._adapters.items() if n != name}

    def _find(self, name: str) -> Adapter:
        adapters = self._adapters
        if name not in adapters:
            raise ValueError(f"adapter must be one of {', '.join(adapters)}, got {name!r}")
        return adapters[name]

    def route(self, request: Request) -> Adapter:
        """Return the adapter that a request names, or else the one of its instruction.

        Raises:
            ValueError: there is no such adapter, or the instruction is not clearly of one.
        """
        prompt, known = request.prompt or self._prompt, self.instructions
        if request.adapter or self.routing == "name":
            return self._find(request.adapter or self._default)
        if not prompt:
            raise ValueError("the request must contain a prompt, or name an adapter")
        if name := routing.exact(prompt, known):
            return self._find(name)
        said = f"{', '.join(known)} were trained for others"
        if self.routing == "nearest":
            name, said = routing.nearest(prompt, known, self._embed)
        if not name:
            raise ValueError(f"no adapter is for {prompt!r}: {said}; name the adapter")
        return self._find(name)

    def _embedding(self, text: str) -> np.ndarray:
        policy = next((each.policy for each in self.adapters if is_shared(each.policy)), None)
        if policy is None:
            raise ValueError("--route nearest needs policies that share a base")
        tokens = policy.tokens(text)
        return embed(policy.policy, tokens["ids"][tokens["mask"]])

    def prepare(self, adapter: Adapter, request: Request, index: tuple[int, int]) -> dict[str, Any]:
        """Convert a request to a row of a batch.

        Args:
            adapter: from `route`.
            request: a request.
            index: numbers of the connection and of the request on it, for the flow's noise.

        Raises:
            ValueError: there is no instruction, or the policy does not know it.
        """
        self._warn(adapter, request.state)
        return self._row(adapter, request, index)

    def _row(self, adapter: Adapter, request: Request, index: tuple[int, int]) -> dict[str, Any]:
        execution, known = self.spec.execution, adapter.policy.instructions
        prompt = request.prompt or self._prompt or (known[0] if len(known) == 1 else "")
        if not prompt:
            raise ValueError("the request must contain a prompt")
        prompt = routing.trained(prompt, known) or prompt
        rest = None
        if execution != "naive":
            rest = np.zeros((0, self.spec.action_length), np.float32)
            if request.executed is not None and request.previous is not None:
                rest = request.previous[request.executed :]
        tokens = adapter.policy.tokens(prompt)
        row = build_row(self.spec, request.images, request.state, tokens, rest, request.delay)
        if rest is not None and execution == "guided":
            row["overlap"] = np.array(len(rest), np.int32)
        return {**row, "index": np.array(index, np.int32)}

    def _warn(self, adapter: Adapter, state: np.ndarray) -> None:
        """Tell the log once of a state that no demonstration can have had."""
        bounds = getattr(adapter.policy, "plausible", None)  # exported ones have none
        if adapter.warned or bounds is None:
            return
        if (beyond := (state < bounds[0]) | (state > bounds[1])).any():
            adapter.warned = True
            number = int(beyond.argmax())
            _log.warning(
                "number %d of a state is %g, but %g to %g would be plausible: check its unit",
                *(number, state[number], *bounds[:, number]),
            )

    def run(self, adapter: Adapter, rows: Sequence[dict[str, Any]]) -> Answer:
        """Return actions and active ranks of B rows; B is one of `sizes`."""
        policy, batch = adapter.policy, jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
        shape = policy.description.chunk, policy.description.action_dim
        batch["noise"] = self._draw(self._key, batch.pop("index"), shape)
        if isinstance(policy, ExportedPolicy):
            return policy.run(batch), None
        return policy.run(batch)


def _of_robot(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Return what all policies of a server must say alike; recordings may differ in names."""
    return {key: value for key, value in metadata.items() if key not in DIMENSIONS}


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


def _descriptions(
    policies: Mapping[str, CompiledPolicy | ExportedPolicy],
) -> dict[str, Description]:
    return {name: policy.description for name, policy in policies.items()}


def common_spec(policies: Mapping[str, Description], execution: str = "naive") -> PolicySpec:
    """Return what all policies need; raise ValueError if they differ or cannot be executed so."""
    shared = [field.name for field in dataclasses.fields(PolicyInterface)]
    first, expected = next(iter(policies.items()))
    for name, description in policies.items():
        for key in (*shared, "metadata"):
            a, b = getattr(expected, key), getattr(description, key)
            if key == "metadata":
                a, b = _of_robot(a), _of_robot(b)
            if a != b:
                raise ValueError(
                    f"{first} and {name} cannot be served together: their {key} is {a} and {b}"
                )
        if execution == "trained" and not description.continues:
            raise ValueError(
                f"{name} was not trained to continue chunks (--optim.rtc-max-delay): choose "
                "another --execution"
            )
    return PolicySpec(**{key: getattr(expected, key) for key in shared}, execution=execution)
