"""Observations as clients send them: this project's own form and those of openpi's examples.

A form says where a request has the robot's state and pictures. `FORMS` lists all of them; a request
has the first form whose keys it contains. More keys work with every form; openpi's servers ignore
them:

    adapter     name of the adapter to use
    reset       true when an episode starts
    executed    s, number of actions of the previous chunk that the robot has executed
    delay       d, number of further ones that it will execute before it switches to the new chunk

`executed` makes the new chunk continue the previous one, as in `models.real_time_chunking`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lorasp_jax.extras.serving import jpeg
from lorasp_jax.extras.serving.exported import PolicyInterface
from lorasp_jax.extras.serving.pictures import to_square

MAX_VALUES = 4096
"""Maximum number of values in a request, see `wire.unpack`; reading one then takes few ms."""
MAX_PROMPT = 1000
"""Maximum length of an instruction [characters]."""


@dataclass(frozen=True)
class PolicySpec(PolicyInterface):
    """What a server's policies need and return.

    Attributes:
        execution: "naive", or how chunks continue the previous one: "trained" or "guided".
    """

    execution: str = "naive"


@dataclass(frozen=True)
class Form:
    """Keys of a request.

    Attributes:
        name: for messages.
        state: keys whose values make up the state, in this order.
        pictures: keys in the order of the policy's cameras; "a/b" is the key b of the map a, unless
            the request has such a key. Empty: `image` maps the policy's camera names to pictures.
        actions: number of action dimensions that the client expects; None: all.
        required: number of pictures that the client must send; None: all.
    """

    name: str
    state: tuple[str, ...]
    pictures: tuple[str, ...] = ()
    actions: int | None = None
    required: int | None = None


FORMS = (
    Form("lorasp_jax", ("state",)),
    # The others are those of openpi's examples (examples/*/main.py, src/openpi/policies/*.py).
    Form(
        "LIBERO",
        ("observation/state",),
        ("observation/image", "observation/wrist_image"),
        actions=7,
    ),
    Form(
        "DROID",
        ("observation/joint_position", "observation/gripper_position"),
        ("observation/exterior_image_1_left", "observation/wrist_image_left"),
        actions=8,
    ),
    Form(
        "ALOHA",
        ("state",),
        ("images/cam_high", "images/cam_left_wrist", "images/cam_right_wrist"),
        actions=14,
        required=1,
    ),
    Form("UR5", ("joints", "gripper"), ("base_rgb", "wrist_rgb"), actions=7),
)


_KEYS = {"image", "images", "prompt", "adapter", "reset", "executed", "delay"}  # of any form


@dataclass(frozen=True)
class Request:
    """A checked request.

    Attributes:
        images: camera -> uint8 `[S, S, 3]`; cameras that the client does not have are absent.
        state: f32 `[J+1]`.
        prompt: instruction, or None.
        adapter: name of an adapter, or None.
        reset: whether an episode starts.
        actions: number of action dimensions to return; None: all.
        executed: s, actions of the previous chunk that the robot has executed; None: the new chunk
            does not continue it.
        delay: d, further actions of the previous chunk that the robot will execute.
        previous: f32 `[C, J+1]`, the previous chunk. The server knows it.
        unknown: keys of the message that have no meaning.
    """

    images: Mapping[str, np.ndarray] = field(repr=False)
    state: np.ndarray
    prompt: str | None = None
    adapter: str | None = None
    reset: bool = False
    actions: int | None = None
    executed: int | None = None
    delay: int = 0
    previous: np.ndarray | None = field(default=None, repr=False)
    unknown: tuple[str, ...] = ()


def parse(message: Any, spec: PolicySpec) -> Request:
    """Check a message and convert its pictures.

    Raises:
        ValueError: it is no request that the policy can answer, in a sentence for the client.
    """
    if not isinstance(message, dict) or not all(isinstance(key, str) for key in message):
        raise ValueError("a request must be a map with text keys")
    form = _form(message)
    state = np.concatenate([_vector(key, message[key]) for key in form.state])
    if state.shape != (spec.state_dim,):
        names = " and ".join(form.state)
        raise ValueError(f"{names} must have {spec.state_dim} values, got {state.size}")
    executed, delay = _progress(message, spec)
    reset = message.get("reset", False)
    if not isinstance(reset, bool | np.bool_):
        raise ValueError(f"reset must be true or false, got {type(reset).__name__}")
    return Request(
        images=_images(message, form, spec),
        state=state,
        prompt=_text("prompt", message.get("prompt")),
        adapter=_text("adapter", message.get("adapter")),
        reset=bool(reset),
        actions=form.actions,
        executed=executed,
        delay=delay,
        unknown=tuple(message.keys() - _KEYS - {*form.state, *form.pictures}),
    )


def _progress(message: Mapping[str, Any], spec: PolicySpec) -> tuple[int | None, int]:
    """Return how many actions of the previous chunk were executed, and how many more will be."""
    executed, delay = message.get("executed"), message.get("delay", 0)
    if executed is None and delay == 0:
        return None, 0
    values = {"delay": delay} if executed is None else {"executed": executed, "delay": delay}
    for name, value in values.items():
        if type(value) is not int or not 0 <= value <= spec.chunk:
            got = str(value)[:40]
            raise ValueError(f"{name} must be an integer from 0 to {spec.chunk}, got {got}")
    if executed is None:
        raise ValueError("delay counts from executed, the actions already executed: send that, too")
    if executed + delay > spec.chunk:
        raise ValueError(
            f"executed and delay must be at most {spec.chunk} together, the length of a chunk, got "
            f"{executed} and {delay}"
        )
    if spec.execution == "naive":
        raise ValueError(
            "this server's chunks do not continue the previous one: start it with --execution "
            "trained or guided, or leave out executed and delay"
        )
    return executed, delay


def _form(message: Mapping[str, Any]) -> Form:
    known = []
    for form in FORMS:
        picture = form.pictures[0] if form.pictures else "image"
        has_picture = picture in message or picture.partition("/")[0] in message
        if has_picture and all(key in message for key in form.state):
            return form
        known.append(f"{form.name}: {', '.join([*form.state, picture])}")
    got, known = ", ".join(sorted(message))[:200] or "none", "; ".join(known)
    raise ValueError(f"a request must have the keys of one of these forms ({known}), got {got}")


def _images(message: Mapping[str, Any], form: Form, spec: PolicySpec) -> dict[str, np.ndarray]:
    keys = form.pictures or [f"image/{camera}" for camera in spec.cameras]
    if len(keys) < len(spec.cameras) and not spec.masks_missing:
        raise ValueError(
            f"the policy needs {len(spec.cameras)} cameras ({', '.join(spec.cameras)}), but "
            f"{form.name} requests have {len(keys)}"
        )
    images = {}
    for number, (camera, key) in enumerate(zip(spec.cameras, keys, strict=False)):
        picture = _lookup(message, key)
        if isinstance(picture, bytes):
            picture = jpeg.decode(key, picture)
        if picture is not None:
            images[camera] = to_square(
                key, picture, spec.image_size, centred=spec.centred, antialias=spec.antialias
            )
        elif form.required is None or number < form.required or not spec.masks_missing:
            raise ValueError(f"the request must contain the picture {key}")
    return images


def _lookup(message: Mapping[str, Any], key: str) -> Any:
    """Return the value of a key, or of a key in a map; None if there is none."""
    if key in message:
        return message[key]
    head, _, rest = key.partition("/")
    inner = message.get(head)
    return inner.get(rest) if isinstance(inner, dict) else None


def _vector(name: str, value: Any) -> np.ndarray:
    """Convert a number, a list of numbers or an array `[n]` to f32 `[n]`."""
    if isinstance(value, list) and all(map(_is_number, value)):
        value = np.array(value, float)
    if isinstance(value, int | float) and not isinstance(value, bool):
        value = np.array([value], float)
    if not isinstance(value, np.ndarray | np.generic) or value.dtype.kind not in "iuf":
        raise ValueError(f"{name} must be numbers, got {_describe(value)}")
    if value.ndim > 1:
        raise ValueError(f"{name} must have one axis, got shape {value.shape}")
    with np.errstate(over="ignore"):  # overflows to inf, which is rejected below
        vector = np.atleast_1d(value).astype(np.float32)
    if not np.isfinite(vector).all():
        raise ValueError(f"{name} must be finite")
    return vector


def _is_number(value: Any) -> bool:
    """Whether a value is a number, also as NumPy's scalar or array `[]`."""
    if isinstance(value, np.ndarray | np.generic):
        return value.ndim == 0 and value.dtype.kind in "iuf"
    return type(value) in (int, float)


def _describe(value: Any) -> str:
    """Name a value's type, and what it consists of."""
    if isinstance(value, dict):
        keys = ", ".join(key if isinstance(key, str) else repr(key) for key in value)
        return f"a map with the keys {keys[:100]}"
    if isinstance(value, list):
        wrong = next((x for x in value if not _is_number(x)), None)
        return f"a list with a value of type {type(wrong).__name__}"
    return type(value).__name__


def _text(name: str, value: Any) -> str | None:
    """Convert text, which some clients send as bytes or as a NumPy string, to str."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    if isinstance(value, bytes):
        try:
            value = value.decode()
        except UnicodeDecodeError as error:
            raise ValueError(f"{name} must be UTF-8 text") from error
    if value is not None and (not isinstance(value, str) or not 0 < len(value) <= MAX_PROMPT):
        got = f"{len(value)} characters" if isinstance(value, str) else type(value).__name__
        raise ValueError(f"{name} must be text of 1 to {MAX_PROMPT} characters, got {got}")
    return value
