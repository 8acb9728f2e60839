"""Answer vla-eval's protocol instead of openpi's, for the benchmarks of that package.

    python -m lorasp_jax.extras.serving runs/NAME --vla-eval 5
    vla-eval run --config BENCHMARK.yaml --server-url ws://127.0.0.1:8000 --no-docker

A benchmark sends an observation at every step and gets one action; the server keeps the chunk and
asks the policy again every 5 steps. Written for vla-eval 0.8.0 (its `docs/` and
`model_servers/pi0.py` at github.com/allenai/vla-evaluation-harness).
"""

import contextlib
import json
import socket
import zlib
from collections.abc import AsyncIterator, Mapping, Sequence
from typing import Any

import anyio
import anyio.to_thread
from vla_eval.model_servers.base import SessionContext
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.serve import serve_async
from vla_eval.specs import IMAGE_RGB, LANGUAGE, DimSpec

from lorasp_jax.extras.serving.batching import padded
from lorasp_jax.extras.serving.requests import Request, parse
from lorasp_jax.extras.serving.served import ServedPolicies


class VlaEvalServer(PredictModelServer):
    """Answers observations of vla-eval's benchmarks with a served policy.

    Pictures go to the policy's cameras of the same names; if one of these is missing, to all of
    them in order, as openpi's requests do. The flow's noise depends on the server's seed, the task
    and the number of the episode, so an evaluation repeats.
    """

    def __init__(self, policies: ServedPolicies, replan: int = 5, **options: Any) -> None:
        """Serve policies that are already compiled.

        Args:
            policies: one policy, whose chunks do not continue the previous one.
            replan: actions executed of each chunk.
            **options: of `PredictModelServer`, such as `action_ensemble`.

        Raises:
            ValueError: there are several policies, chunks continue, or `replan` does not fit.
        """
        chunk, execution = policies.spec.chunk, policies.spec.execution
        if not 1 <= replan <= chunk:
            raise ValueError(f"--vla-eval must be from 1 to {chunk}, the chunk, got {replan}")
        if len(policies.instructions) > 1 or execution != "naive":
            raise ValueError("vla-eval's protocol needs one policy, and --execution naive")
        super().__init__(chunk_size=replan, max_batch_size=policies.sizes[-1], **options)
        self._policies = policies
        self._episodes: dict[str, int] = {}

    async def on_observation(self, obs: dict[str, Any], ctx: SessionContext) -> None:
        """Answer an observation; one that has no answer is refused before it is in a batch.

        Raises:
            ValueError: the policy cannot answer it, in a sentence for the client.
        """
        row = await anyio.to_thread.run_sync(self._row, obs, ctx)
        await super().on_observation(row, ctx)

    def predict_batch(
        self, obs_batch: list[dict[str, Any]], ctx_batch: list[SessionContext]
    ) -> list[dict[str, Any]]:
        """Return a chunk, f32 `[C, A]`, as "actions" of each result of `_row`."""
        del ctx_batch
        sizes, adapter = self._policies.sizes, obs_batch[0]["adapter"]  # there is one
        rows, chunks = [each["row"] for each in obs_batch], []
        for start in range(0, len(rows), sizes[-1]):  # clients may raise max_batch_size
            batch = rows[start : start + sizes[-1]]
            actions, _ = self._policies.run(adapter, padded(batch, sizes))
            chunks += [*actions[: len(batch)]]
        return [{"actions": chunk} for chunk in chunks]

    def _row(self, observation: Mapping[str, Any], context: SessionContext) -> dict[str, Any]:
        request = read(observation, self._policies)
        index = self._episodes[context.session_id], context.step
        adapter = self._policies.route(request)
        return {"adapter": adapter, "row": self._policies.prepare(adapter, request, index)}

    async def on_episode_start(self, config: dict[str, Any], ctx: SessionContext) -> None:
        """Forget the last chunk; choose the episode's noise."""
        await super().on_episode_start(config, ctx)
        task = json.dumps(config.get("task"), sort_keys=True)  # with the episode's number
        self._episodes[ctx.session_id] = zlib.crc32(task.encode()) >> 1  # an int32

    async def on_episode_end(self, result: dict[str, Any], ctx: SessionContext) -> None:
        """Forget the episode."""
        await super().on_episode_end(result, ctx)
        self._episodes.pop(ctx.session_id, None)

    def problem(self) -> None:
        """Return None: vla-eval answers no questions about its health."""

    def close(self, _timeout: float) -> bool:
        """Return True: everything has ended with `listen`."""
        return True

    def get_action_spec(self) -> dict[str, DimSpec]:
        """Describe actions, whose meaning is that of the training data."""
        return {"actions": DimSpec("actions", self._policies.spec.action_length, "raw")}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        """Describe observations, without the state: its meaning is that of the training data."""
        return {"language": LANGUAGE, **dict.fromkeys(self._policies.spec.cameras, IMAGE_RGB)}

    def get_observation_params(self) -> dict[str, Any]:
        """Ask benchmarks for what most send only on demand."""
        return {"send_state": True, "send_wrist_image": len(self._policies.spec.cameras) > 1}

    @contextlib.asynccontextmanager
    async def listen(self, port: socket.socket) -> AsyncIterator[None]:
        """Accept connections on a port from `server.bind` while the context is open."""
        host, number = port.getsockname()[:2]
        port.close()  # vla-eval opens it itself
        async with anyio.create_task_group() as tasks:
            await tasks.start(serve_async, self, host, number)
            yield
            tasks.cancel_scope.cancel()


def read(observation: Mapping[str, Any], policies: ServedPolicies) -> Request:
    """Convert an observation of vla-eval: `images`, `states` or `state`, and `task_description`.

    Raises:
        ValueError: it is none that the policy can answer.
    """
    cameras: Sequence[str] = policies.spec.cameras
    images, state = observation.get("images"), observation.get("states", observation.get("state"))
    if not isinstance(images, Mapping) or state is None:
        raise ValueError(
            "an observation must have images and a state, which most benchmarks send with "
            f"--param send_state=true; got {', '.join(map(str, observation))}"
        )
    if not set(cameras) <= set(images):
        images = dict(zip(cameras, images.values(), strict=False))
    prompt = observation.get("task_description")
    return parse({"image": dict(images), "state": state, "prompt": prompt}, policies.spec)
