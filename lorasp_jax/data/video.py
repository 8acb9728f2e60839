"""Pictures of a dataset as files have them: frames of a video, encoded pictures."""

import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import av.error
import numpy as np
from av.video.reformatter import VideoReformatter
from PIL import Image

from envs.datasets.files import check_memory, reason

# What a file may be: FFmpeg itself also reads playlists, which name other files and addresses.
_CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi"
_OPTIONS = {"format_whitelist": _CONTAINERS, "protocol_whitelist": "file"}
_PICTURES = ("PNG", "JPEG")
_TOLERANCE = 0.25
"""Share of a frame's time by which it may be early or late: the next frame is never taken for it,
and a video of another rate is found out within its first frames."""


class Film:
    """A video file, read forwards; reading on where the last read ended decodes nothing twice.

    Attributes:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        """Opens the file.

        Raises:
            ValueError: there is none, or it is damaged.
        """
        self.path = path
        try:
            self._container: Any = av.open(f"file:{path}", container_options=_OPTIONS)
            self._stream = self._container.streams.video[0]
        except (av.error.FFmpegError, OSError, ValueError, IndexError) as error:
            raise ValueError(f"{path} is no whole video ({reason(error)})") from error
        self._stream.thread_type = "AUTO"
        self._frames: Iterator[Any] = self._container.decode(self._stream)
        # One for all frames, and no threads of its own: a frame's own one takes as long to set up
        # as to run.
        self._colours = VideoReformatter()
        self._end = 0.0  # of what has been decoded [s]

    def read(
        self, start: float, length: int, fps: float, *, every: int = 1, image_size: int = 0
    ) -> np.ndarray:
        """Frames of a stretch of the film.

        Args:
            start: time of the first frame [s].
            length: frames of the stretch.
            fps: frames a second.
            every: only every so many-th is wanted.
            image_size: see `reduced`.

        Returns:
            uint8 `[ceil(length / every), H, W, 3]`.

        Raises:
            ValueError: the film ends too early, is damaged, or runs at another rate.
        """
        tolerance, pictures = _TOLERANCE / fps, np.empty(0)
        if not abs(start - self._end) <= tolerance:  # so also after a read that failed
            self._seek(start)
        for number in range(length):
            frame = self._next(start - tolerance, number, length)
            wanted = start + number / fps
            if abs(frame.time - wanted) > tolerance:
                raise ValueError(
                    f"{self.path} has a frame at {frame.time:.3f} s where one is due at "
                    f"{wanted:.3f} s: it does not run at the dataset's {fps:g} frames a second"
                )
            if number % every == 0:
                rgb = self._colours.reformat(frame, format="rgb24", threads=1)
                picture = reduced(rgb.to_ndarray(), image_size)
                if not number:  # into one array at once: a list to stack would be as much again
                    shape = (-(-length // every), *picture.shape)
                    check_memory(math.prod(shape), f"an episode in {self.path}")
                    pictures = np.empty(shape, np.uint8)
                pictures[number // every] = picture
        self._end = start + length / fps
        return pictures

    def _seek(self, start: float) -> None:
        """Goes to the last key frame before a time [s]."""
        try:
            self._container.seek(round(start / self._stream.time_base), stream=self._stream)
        except (av.error.FFmpegError, OSError, OverflowError) as error:
            raise ValueError(f"{self.path} has nothing at {start:g} s ({reason(error)})") from error
        self._frames = self._container.decode(self._stream)

    def _next(self, earliest: float, number: int, length: int) -> Any:
        """The next frame that is not before a time [s]."""
        self._end = float("nan")  # until all went well
        try:
            return next(frame for frame in self._frames if frame.time >= earliest)
        except StopIteration:
            why = "it ends there"
        except (av.error.FFmpegError, OSError) as error:
            why = reason(error)
        raise ValueError(f"{self.path} gives {number} of {length} frames of an episode ({why})")

    def close(self) -> None:
        """Closes the file."""
        self._container.close()


def decoded(file: bytes, image_size: int = 0) -> np.ndarray:
    """A PNG or JPEG picture as uint8 `[H, W, 3]`; see `reduced`.

    Raises:
        ValueError: it is damaged, or has too many pixels for a picture.
    """
    try:
        with Image.open(io.BytesIO(file), formats=_PICTURES) as picture:
            if picture.width * picture.height > (Image.MAX_IMAGE_PIXELS or math.inf):
                raise ValueError(f"it has {picture.width} x {picture.height} pixels")
            return reduced(np.asarray(picture.convert("RGB")), image_size)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise ValueError(f"a picture is damaged ({reason(error)})") from error


def reduced(picture: np.ndarray, image_size: int) -> np.ndarray:
    """A picture uint8 `[H, W, 3]` whose longer side has at most so many pixels; 0: as it is.

    The filter is the one openpi's clients use (openpi_client/image_tools.py): bilinear, smoothed.
    """
    height, width, _ = picture.shape
    longest = max(height, width)
    if not image_size or longest <= image_size:
        return picture
    size = (max(1, width * image_size // longest), max(1, height * image_size // longest))
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BILINEAR))
