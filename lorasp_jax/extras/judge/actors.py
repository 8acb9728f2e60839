"""Where actions come from: a policy server, or the policy of a run in this process."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np


class Actor(Protocol):
    """Returns action chunks."""

    def reset(self, seed: int) -> None:
        """Start an episode; `seed` sets the noise of its actions."""
        ...

    def act(
        self, images: Mapping[str, np.ndarray], state: np.ndarray, instruction: str
    ) -> np.ndarray:
        """Return a chunk f32 `[C, A]` for pictures uint8 `[H, W, 3]` and a state `[D]`."""
        ...


class ServerActor:
    """Asks a policy server.

    The noise of the actions depends on the server's `--seed` and on the number of the connection.
    """

    def __init__(self, address: str, *, token: str = "", wait: float = 0.0) -> None:
        """Connect, trying again for `wait` seconds.

        Raises:
            ValueError: the client's dependencies are not installed.
            ServerGone: there is no server.
        """
        try:
            from lorasp_jax.extras.serving.client import PolicyClient
        except ModuleNotFoundError as error:
            raise ValueError("--server needs pip install websockets msgpack") from error
        self._client = PolicyClient(address, token=token, wait=wait, timeout=60)

    def reset(self, seed: int) -> None:  # noqa: ARG002
        """Start an episode."""
        self._client.reset()

    def act(
        self, images: Mapping[str, np.ndarray], state: np.ndarray, instruction: str
    ) -> np.ndarray:
        """Return a chunk.

        Raises:
            ValueError: the server refuses the observation, with its sentence.
            ServerGone: the connection is lost.
        """
        from lorasp_jax.extras.serving.client import PolicyError

        request = {"image": dict(images), "state": state, "prompt": instruction}
        try:
            return np.asarray(self._client.infer(request)["actions"])
        except PolicyError as error:
            raise ValueError(f"the policy server refused: {error}") from error

    def close(self) -> None:
        """Close the connection."""
        self._client.close()


class RunActor:
    """Samples the policy of a finished run in this process."""

    def __init__(self, run: Path, instructions: Sequence[str], *, num_steps: int = 10) -> None:
        """Load the policy, with prompts of any instructions.

        Raises:
            ValueError: the run has no policy, an instruction is too long for it, or this project's
                dependencies are not installed.
        """
        try:
            import jax

            from lorasp_jax.base import hub
            from lorasp_jax.policies.tokenizer import load_tokenizer
            from lorasp_jax.training.export import describe, load_policy
        except ModuleNotFoundError as error:
            raise ValueError(
                f"{run} needs {error.name}, which is not installed here: serve it elsewhere with "
                f"python -m lorasp_jax.extras.serving {run}, and give --server"
            ) from error

        policy = load_policy(run)
        words = load_tokenizer(hub.resolve_portable(describe(run)["policy"]["tokenizer"]))
        self._rows = {text: row for row, text in enumerate(dict.fromkeys(instructions))}
        prompts = policy.processor.prompts.with_instructions(words, [*self._rows])
        processor = dataclasses.replace(policy.processor, prompts=prompts)
        self._policy = dataclasses.replace(policy, processor=processor).with_sampler()
        self._sample: Any = jax.jit(
            lambda policy, key, observation, row: policy.sample(
                key, observation, row, num_steps=num_steps
            )[0]
        )
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Start an episode."""
        import jax

        self._key = jax.random.key(seed)

    def act(
        self, images: Mapping[str, np.ndarray], state: np.ndarray, instruction: str
    ) -> np.ndarray:
        """Return a chunk.

        Raises:
            ValueError: the policy needs another camera or a state of another length.
        """
        import jax

        self._key, key = jax.random.split(self._key)
        observation = {
            "image": {name: picture[None] for name, picture in images.items()},
            "state": state[None],
        }
        row = np.array([self._rows[instruction]], np.int32)
        return np.asarray(self._sample(self._policy, key, observation, row))
