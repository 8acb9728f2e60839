"""Finished runs that share a base, and the server that swaps them."""

import functools
import http.client
import json

import jax
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import native
from lorasp_jax.extras.serving import loading
from lorasp_jax.extras.serving.adapters import Bases, OnDevice
from lorasp_jax.extras.serving.policies import CompiledPolicy
from lorasp_jax.extras.serving.served import ServedPolicies
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.training import export
from tests.models.random_models import with_noise

TEXTS = {
    "press": ("press the red button", "push the button down"),
    "pour": ("pour the cup over the basket", "tilt the cup above the basket"),
    "open": ("open the pot", "take the lid off the pot"),
}


def write_run(source, folder, seed, instructions=TEXTS["press"], config=None, **said):
    """Write a run like that in `source`, with other adapters and instructions.

    `config` has fields of the model's config, and `said` those of the run's metadata.
    """
    policy, metadata = export.load_policy(source), export.describe(source)
    words = loading.load_run(str(source)).words
    prompts = PromptTable.of(words, instructions, policy.model.config, num_joints=6)
    fields = {"instructions": [*instructions], "prompts": export._prompts_digest(prompts)}
    metadata["policy"] |= fields
    metadata["policy"]["config"] |= config or {}
    metadata |= said
    graphdef, adapters, frozen = adaptation.split(policy.model)
    model = nnx.merge(graphdef, with_noise(adapters, 0.3, seed), frozen)
    native.save_adapters(folder, model, metadata=metadata)
    return str(folder)


def serve_runs(runs, *, capacity=None, max_batch=2, share=True, **options):
    """Return `ServedPolicies` of runs by name, on one base."""
    bases, place = Bases(), OnDevice(capacity)
    compiled = functools.partial(CompiledPolicy, num_steps=2, max_batch=max_batch, place=place)

    def load(run, first=False):
        model = functools.partial(bases.sampler, load=first) if share else None
        return compiled(loading.load_run(run, model=model))

    policies = {name: load(run, first=True) for name, run in runs.items()}
    served = ServedPolicies(policies, load=load if share else None, **options)
    served.place = place
    return served


def live_bytes():
    return sum(array.nbytes for array in jax.live_arrays())


def post(server, values, token="secret"):
    """POST /adapters; return status and text."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    headers = {"Authorization": f"Api-Key {token}"} if token else {}
    body = values if isinstance(values, bytes) else json.dumps(values).encode()
    connection.request("POST", "/adapters", body, headers)
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


def get(server, path, token="secret"):
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    connection.request("GET", path, headers={"Authorization": f"Api-Key {token}"})
    answer = connection.getresponse()
    return answer.status, answer.read().decode()
