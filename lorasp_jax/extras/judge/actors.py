"""Where actions come from: a policy server, or the policy of a run in this process."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np


class ServerActor:
    """Asks a policy server.

    The noise of the actions depends on the server's `--seed` and on the number of the connection.
    """

    def __init__(self, address: str, *, token: str = "", wait: float = 0.0) -> None:
        """Connect, trying again for `wait` seconds.

        Raises:
            ModuleNotFoundError: the client's dependencies are not installed.
            ServerGone: there is no server.
        """
        from lorasp_jax.extras.serving import client

        self._client = client.PolicyClient(address, token=token, wait=wait, timeout=60)
        self._refusal = client.PolicyError

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
        request = {"image": dict(images), "state": state, "prompt": instruction}
        try:
            return np.asarray(self._client.infer(request)["actions"])
        except self._refusal as error:
            raise ValueError(f"the policy server refused: {error}") from error

    def close(self) -> None:
        """Close the connection."""
        self._client.close()


class RunActor:
    """Samples the policy of a finished run in this process, as its server would."""

    def __init__(self, run: Path, instructions: Sequence[str]) -> None:
        """Load the policy, which takes the flow steps of the run's evaluation.

        Raises:
            ValueError: the run has no policy, an instruction is too long for it, or this project's
                dependencies are not installed.
        """
        try:
            from lorasp_jax.extras.serving import loading, requests, served
            from lorasp_jax.extras.serving.policies import CompiledPolicy
        except ModuleNotFoundError as error:
            raise ValueError(
                f"{run} needs {error.name}, which is not installed here: serve it elsewhere with "
                f"python -m lorasp_jax.extras.serving {run}, and give --server"
            ) from error

        self._parse = requests.parse
        policy = CompiledPolicy(loading.load_run(str(run)), max_batch=1)
        for text in instructions:
            policy.tokens(text)
        self._policy = served.ServedPolicies({"run": policy})
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Start an episode."""
        self._episode, self._calls = seed % 2**31, 0  # an int32

    def act(
        self, images: Mapping[str, np.ndarray], state: np.ndarray, instruction: str
    ) -> np.ndarray:
        """Return a chunk.

        Raises:
            ValueError: the policy needs another camera or a state of another length.
        """
        spec = self._policy.spec
        if missing := [name for name in spec.cameras if name not in images]:
            raise ValueError(f"the policy needs the camera {missing[0]}: name it in the task")
        message = {"image": dict(images), "state": state, "prompt": instruction}
        request, index = self._parse(message, spec), (self._episode, self._calls)
        adapter = self._policy.route(request)
        row = self._policy.prepare(adapter, request, index)
        self._calls += 1
        return self._policy.run(adapter, [row])[0][0]


Actor: TypeAlias = ServerActor | RunActor
"""Returns action chunks, f32 `[C, A]`, for pictures uint8 `[H, W, 3]` and a state `[D]`."""
