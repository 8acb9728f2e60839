"""Choose an adapter by a request's instruction; refuse rather than guess.

Embeddings are the mean of the base's token embeddings, minus their mean over all known
instructions, compared by cosine. On 48 paraphrases of the four tasks' instructions, and on each of
the 20 instructions with the others known, the nearest one is always of the right task (68 of 68,
pi0 nano; cosines of word counts: 66, of character n-grams: 68 with smaller margins). With
`THRESHOLD` and `MARGIN`, 61 of them are answered. Of 20 commands for other tasks, 16 are refused;
the others have almost only known words, as "press the blue button", "put the lid on the pot".
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

MODES = ("name", "exact", "nearest")
"""How adapters are chosen for requests that name none: the first, or by instruction."""
THRESHOLD, MARGIN = 0.6, 0.2
"""Smallest cosine of the nearest instruction, and by how much it must exceed other adapters'."""

Instructions = Mapping[str, Sequence[str]]
"""Instructions by adapter."""


def trained(prompt: str, instructions: Sequence[str]) -> str:
    """Return the instruction that a prompt is, "" if it is none of them.

    Case, spaces and a final punctuation mark do not matter, unless instructions differ in these.
    """
    same = [text for text in instructions if _plain(text) == _plain(prompt)]
    return prompt if prompt in same else next(iter(same), "")


def exact(prompt: str, instructions: Instructions) -> str:
    """Return the adapter that was trained with an instruction, see `trained`; "" if none was.

    Raises:
        ValueError: several adapters have it.
    """
    found = [name for name, texts in instructions.items() if trained(prompt, texts)]
    if len(found) > 1:
        raise ValueError(f"{prompt!r} is an instruction of {', '.join(found)}: name the adapter")
    return found[0] if found else ""


def shared(instructions: Instructions) -> dict[str, list[str]]:
    """Return the instructions that several adapters have, and which; `exact` refuses these."""
    owners: dict[str, dict[str, str]] = {}
    for name, texts in instructions.items():
        for text in texts:
            owners.setdefault(_plain(text), {})[name] = text
    return {next(iter(x.values())): [*x] for x in owners.values() if len(x) > 1}


def nearest(
    prompt: str, instructions: Instructions, embed: Callable[[str], np.ndarray]
) -> tuple[str, str]:
    """Return the adapter with the nearest instruction, or "", and a sentence on the closest.

    Args:
        prompt: of the request.
        instructions: by adapter.
        embed: text -> f32 `[D]`.
    """
    known = [(name, text) for name, texts in instructions.items() for text in texts]
    if not known:
        return "", "no adapter has instructions"
    vectors = np.stack([embed(text) for _, text in known])
    center = vectors.mean(axis=0)
    cosines = _unit(vectors - center) @ _unit(embed(prompt) - center)
    best = int(np.argmax(cosines))
    name, text = known[best]
    others = [c for c, (other, _) in zip(cosines, known, strict=True) if other != name]
    margin = cosines[best] - max(others, default=-1.0)
    said = f"the nearest is {text!r} of {name}, similarity {cosines[best]:.2f}, {margin:.2f} ahead"
    return name if cosines[best] >= THRESHOLD and margin >= MARGIN else "", said


def _plain(text: str) -> str:
    return " ".join(text.casefold().split()).rstrip(".!?")


def _unit(vectors: np.ndarray) -> np.ndarray:
    norms = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.maximum(norms, 1e-12)
