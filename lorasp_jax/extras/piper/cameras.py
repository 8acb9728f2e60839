"""Pictures of named cameras: V4L2 devices, or anything else that ffmpeg can read."""

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from types import MappingProxyType
from typing import Any

import av
import numpy as np
from av.error import FFmpegError

from lorasp_jax.extras.piper.safety import Unsafe

MAX_AGE = 0.3
"""Age beyond which a picture is stale [s]: nine frames at 30 per second; our choice."""
_DEFAULT: Mapping[str, str] = MappingProxyType({})  # as the device likes


class NoPicture(Unsafe):
    """A picture is stale."""


Look = Callable[[], dict[str, np.ndarray]]
"""Returns the newest picture of each camera, uint8 [H, W, 3]; raises `NoPicture` if it is stale."""


class Camera:
    """One source of pictures, decoded in a thread that keeps only the newest."""

    def __init__(self, name: str, source: str, options: Mapping[str, str] = _DEFAULT) -> None:
        """Open a source and wait for its first picture.

        Args:
            name: of the camera, such as wrist.
            source: a device such as /dev/video0, or a file or address that ffmpeg can read.
            options: what ffmpeg asks a device for: video_size, framerate, input_format.

        Raises:
            ConnectionError: the source cannot be opened, or shows nothing.
        """
        self._name, self._newest, self._stop = name, (-np.inf, None), False
        device = source.startswith("/dev/")
        try:
            self._container: Any = av.open(
                source,
                format="v4l2" if device else None,
                options=dict(options) if device else {},
            )
        except (FFmpegError, OSError, ValueError) as error:
            raise ConnectionError(f"cannot open camera {name} at {source}: {error}") from error
        self._first = threading.Event()
        self._thread = threading.Thread(target=self._decode, daemon=True)
        self._thread.start()
        if not self._first.wait(5.0):
            raise ConnectionError(f"camera {name} at {source} shows nothing")

    def read(self) -> np.ndarray:
        """Return the newest picture, uint8 [H, W, 3].

        Raises:
            NoPicture: it is stale.
        """
        taken, image = self._newest
        if image is None or time.monotonic() - taken > MAX_AGE:
            raise NoPicture(f"camera {self._name} shows nothing new")
        return image

    def close(self) -> None:
        """Stop decoding."""
        self._stop = True
        self._thread.join(1.0)

    def _decode(self) -> None:
        try:
            for frame in self._container.decode(video=0):
                self._newest = time.monotonic(), frame.to_ndarray(format="rgb24")
                self._first.set()
                if self._stop:
                    break
        except (FFmpegError, OSError, ValueError):
            pass  # the picture goes stale, which `read` reports
        self._container.close()


def open_cameras(
    sources: Mapping[str, str], stack: ExitStack, options: Mapping[str, str] = _DEFAULT
) -> Look:
    """Open camera name -> source until the stack is closed; `options` as in `Camera`.

    Raises:
        ConnectionError: a source cannot be opened.
    """
    cameras: dict[str, Camera] = {}
    for name, source in sources.items():
        cameras[name] = Camera(name, source, options)
        stack.callback(cameras[name].close)
    return lambda: {name: camera.read() for name, camera in cameras.items()}
