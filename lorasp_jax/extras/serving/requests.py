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

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lorasp_jax.extras.serving.pictures import to_square

MAX_PROMPT = 1000
"""Maximum length of an instruction [characters]."""
_ABSENT = object()


@dataclass(frozen=True)
class PolicySpec:
    """What a policy needs to know of a robot, and what it returns.

    Attributes:
        cameras: names of the robot's cameras; the third-person view comes first.
        image_size: height and width of the images [pixels].
        state_dim: J+1, the length of states and actions.
        chunk: C, actions per reply.
        masks_missing: whether the policy works without some of its cameras.
        centred: how pictures that are not square are padded; see `pictures.to_square`.
        antialias: how pictures are resized.
        instructions: those that the policy was trained with.
        execution: "naive", or how chunks continue the previous one: "trained" or "guided".
    """

    cameras: tuple[str, ...]
    image_size: int
    state_dim: int
    chunk: int
    masks_missing: bool = False
    centred: bool = True
    antialias: bool = True
    instructions: tuple[str, ...] = ()
    execution: str = "naive"


@dataclass(frozen=True)
class View:
    """A picture of a form: its key, or the keys of nested maps."""

    path: tuple[str, ...]
    required: bool = True


@dataclass(frozen=True)
class Form:
    """Keys of a request.

    Attributes:
        name: for messages and the server's metadata.
        state: keys whose values make up the state, in this order.
        views: pictures, in the order of the policy's cameras. Empty: the key `image` maps the
            policy's camera names to pictures.
        actions: number of action dimensions that the client expects; None: all.
    """

    name: str
    state: tuple[str, ...]
    views: tuple[View, ...] = ()
    actions: int | None = None


FORMS = (
    Form("lorasp_jax", ("state",)),
    # The others are those of openpi's examples (examples/*/main.py, src/openpi/policies/*.py).
    Form(
        "LIBERO",
        ("observation/state",),
        (View(("observation/image",)), View(("observation/wrist_image",))),
        actions=7,
    ),
    Form(
        "DROID",
        ("observation/joint_position", "observation/gripper_position"),
        (View(("observation/exterior_image_1_left",)), View(("observation/wrist_image_left",))),
        actions=8,
    ),
    Form(
        "ALOHA",
        ("state",),
        (
            View(("images", "cam_high")),
            View(("images", "cam_left_wrist"), required=False),
            View(("images", "cam_right_wrist"), required=False),
        ),
        actions=14,
    ),
    Form("UR5", ("joints", "gripper"), (View(("base_rgb",)), View(("wrist_rgb",))), actions=7),
)


@dataclass(frozen=True)
class Request:
    """A checked request.

    Attributes:
        images: camera -> uint8 `[S, S, 3]`; cameras that the client does not have are absent.
        state: f32 `[J+1]`.
        prompt: instruction, or None.
        adapter: name of an adapter, or None.
        reset: whether an episode starts.
        actions: number of action dimensions to return.
        executed: s, actions of the previous chunk that the robot has executed; None: the new chunk
            does not continue it.
        delay: d, further actions of the previous chunk that the robot will execute.
        previous: f32 `[C, J+1]`, the previous chunk. The session knows it.
    """

    images: Mapping[str, np.ndarray] = field(repr=False)
    state: np.ndarray
    prompt: str | None
    adapter: str | None
    reset: bool
    actions: int
    executed: int | None = None
    delay: int = 0
    previous: np.ndarray | None = field(default=None, repr=False)


def choose_prompt(request: Request, default: str, spec: PolicySpec) -> str:
    """Return the request's instruction, the default, or a policy's only one.

    Raises:
        ValueError: there is none.
    """
    only = spec.instructions[0] if len(spec.instructions) == 1 else ""
    prompt = request.prompt or default or only
    if not prompt:
        raise ValueError("the request must contain a prompt")
    return prompt


def common_spec(specs: Mapping[str, PolicySpec]) -> PolicySpec:
    """Return what all policies need, without their instructions.

    Raises:
        ValueError: they need different observations.
    """
    (first, expected), *others = specs.items()
    for name, spec in others:
        for key in (each.name for each in dataclasses.fields(spec)):
            a, b = getattr(expected, key), getattr(spec, key)
            if a != b and key != "instructions":
                raise ValueError(
                    f"{first} and {name} cannot be served together: their {key} is {a} and {b}"
                )
    return dataclasses.replace(expected, instructions=())


def parse(message: Any, spec: PolicySpec) -> Request:
    """Check a decoded message and convert it to a request.

    Raises:
        ValueError: keys are missing, or a value has the wrong type, shape or range; the message is
            one sentence for the client.
    """
    if not isinstance(message, dict) or not all(isinstance(key, str) for key in message):
        raise ValueError("a request must be a map with text keys")
    form = _form(message)
    state = np.concatenate([_vector(key, message[key]) for key in form.state])
    if state.shape != (spec.state_dim,):
        raise ValueError(
            f"{' and '.join(form.state)} must have {spec.state_dim} values, got {state.size}"
        )
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
        actions=min(form.actions or spec.state_dim, spec.state_dim),
        executed=executed,
        delay=delay,
    )


def _progress(message: Mapping[str, Any], spec: PolicySpec) -> tuple[int | None, int]:
    """Return how many actions of the previous chunk were executed, and how many more will be."""
    executed, delay = message.get("executed"), message.get("delay", 0)
    if executed is None and delay == 0:
        return None, 0
    for name, value, most in (("executed", executed, spec.chunk), ("delay", delay, spec.chunk)):
        if type(value) is not int or not 0 <= value <= most:
            raise ValueError(f"{name} must be an integer from 0 to {most}, got {str(value)[:40]}")
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
    for form in FORMS:
        first = form.views[0].path if form.views else ("image",)
        if all(key in message for key in form.state) and first[0] in message:
            return form
    known = "; ".join(f"{form.name}: {', '.join(_keys(form))}" for form in FORMS)
    got = ", ".join(sorted(message))[:200] or "none"
    raise ValueError(f"a request must have the keys of one of these forms ({known}), got {got}")


def _keys(form: Form) -> list[str]:
    pictures = ["/".join(view.path) for view in form.views if view.required] or ["image"]
    return [*form.state, *pictures]


def _images(message: Mapping[str, Any], form: Form, spec: PolicySpec) -> dict[str, np.ndarray]:
    if form.views:
        pairs = zip(spec.cameras, form.views, strict=False)
        views = {camera: view for camera, view in pairs}
    else:
        views = {camera: View(("image", camera)) for camera in spec.cameras}
    if len(views) < len(spec.cameras) and not spec.masks_missing:
        raise ValueError(
            f"the policy needs {len(spec.cameras)} cameras ({', '.join(spec.cameras)}), but "
            f"{form.name} requests have {len(views)}"
        )
    images = {}
    for camera, view in views.items():
        name, picture = "/".join(view.path), _lookup(message, view.path)
        if picture is _ABSENT and (view.required or not spec.masks_missing):
            raise ValueError(f"the request must contain the picture {name}")
        if picture is not _ABSENT:
            images[camera] = to_square(
                name, picture, spec.image_size, centred=spec.centred, antialias=spec.antialias
            )
    return images


def _lookup(message: Any, path: tuple[str, ...]) -> Any:
    for key in path:
        if not isinstance(message, dict) or key not in message:
            return _ABSENT
        message = message[key]
    return message


def _vector(name: str, value: Any) -> np.ndarray:
    """Convert a number, a list of numbers or an array `[n]` to f32 `[n]`."""
    if isinstance(value, list) and all(type(x) in (int, float) for x in value):
        value = np.array(value, float)
    if isinstance(value, int | float) and not isinstance(value, bool):
        value = np.array([value], float)
    if not isinstance(value, np.ndarray | np.generic) or value.dtype.kind not in "iuf":
        raise ValueError(f"{name} must be numbers, got {type(value).__name__}")
    if value.ndim > 1:
        raise ValueError(f"{name} must have one axis, got shape {value.shape}")
    with np.errstate(over="ignore"):  # overflows to inf, which is rejected below
        vector = np.atleast_1d(value).astype(np.float32)
    if not np.isfinite(vector).all():
        raise ValueError(f"{name} must be finite")
    return vector


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
