"""Decode a dataset's images: video frames, PNG and JPEG files."""

import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import av.error
import numpy as np
from av.video.reformatter import VideoReformatter
from PIL import Image, ImageOps, UnidentifiedImageError

from lorasp_jax.base.files import RefusedError, as_value_error, check_memory

# Allowed containers: FFmpeg would also read playlists, which refer to other files and URLs.
_CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi"
_OPTIONS = {"format_whitelist": _CONTAINERS, "protocol_whitelist": "file"}
_FORMATS = ("PNG", "JPEG")
_ONE_CHANNEL = ("1", "L", "LA", "La", "I", "F")
"""Pillow's modes without colors; 16-bit ones are "I;16" and the like."""
_TOLERANCE = 0.25
"""Tolerance of a frame's time, in frame periods. It is small enough to tell adjacent frames apart,
and to notice a wrong frame rate within a few frames."""

_ONE_THREAD: dict[str, Any] = {"threads": 1} if int(av.__version__.partition(".")[0]) >= 17 else {}
"""For conversions, which have threads of their own only since PyAV 17; LeRobot wants PyAV 15."""


class VideoReader:
    """A video file, decoded sequentially; consecutive reads decode each frame only once.

    Attributes:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            ValueError: the file is missing or damaged, or has no colors.
        """
        self.path = path
        with as_value_error(path, av.error.FFmpegError):
            self._container: Any = av.open(f"file:{path}", container_options=_OPTIONS)
            if not self._container.streams.video:
                raise ValueError("it has no video")
            self._stream = self._container.streams.video[0]
            _check_color(self._stream.codec_context.pix_fmt or "", str(path))
        self._stream.thread_type = "AUTO"
        self._frames: Iterator[Any] = self._container.decode(self._stream)
        # Shared by all frames: creating a reformatter takes as long as converting a frame.
        self._reformatter = VideoReformatter()
        self._end = 0.0  # end time of the last read [s]

    def read(
        self, start: float, length: int, fps: float, *, every: int = 1, image_size: int = 0
    ) -> np.ndarray:
        """Decode consecutive frames.

        Args:
            start: time of the first frame [s].
            length: number of frames.
            fps: frames per second.
            every: keep every N-th frame.
            image_size: see `downscale`.

        Returns:
            uint8 `[ceil(length / every), H, W, 3]`.

        Raises:
            ValueError: the video is too short or damaged, or has another frame rate.
        """
        tolerance, images = _TOLERANCE / fps, np.empty(0)
        if not abs(start - self._end) <= tolerance:  # also true after a failed read: _end is NaN
            self._seek(start)
        for number in range(length):
            frame = self._next(start - tolerance, number, length)
            expected = start + number / fps
            if abs(frame.time - expected) > tolerance:
                raise ValueError(f"{self.path} does not have {fps:g} fps at {expected:.3f} s")
            if number % every == 0:
                rgb = self._reformatter.reformat(frame, format="rgb24", **_ONE_THREAD)
                image = downscale(rgb.to_ndarray(), image_size)
                if not number:  # preallocate: stacking a list would double the memory
                    shape = (-(-length // every), *image.shape)
                    check_memory(math.prod(shape), f"an episode in {self.path}")
                    images = np.empty(shape, np.uint8)
                check_same_size(image, images[0], self.path)
                images[number // every] = image
        self._end = start + length / fps
        return images

    def _seek(self, start: float) -> None:
        """Seek to the last key frame at or before a time [s]."""
        with as_value_error(self.path, av.error.FFmpegError):
            self._container.seek(round(start / self._stream.time_base), stream=self._stream)
        self._frames = self._container.decode(self._stream)

    def _next(self, earliest: float, number: int, length: int) -> Any:
        """Decode the next frame at or after a time [s]."""
        self._end = float("nan")  # until `read` succeeds
        with as_value_error(self.path, av.error.FFmpegError):
            for frame in self._frames:
                if frame.time >= earliest:
                    return frame
            raise EOFError(f"it has only {number} of {length} frames of an episode")

    def close(self) -> None:
        """Close the file."""
        self._container.close()


def decode_image(file: bytes, what: str, image_size: int = 0) -> np.ndarray:
    """Decode a PNG or JPEG image to uint8 `[H, W, 3]`, downscaled by `downscale`.

    Args:
        file: the content of the file.
        what: the image's name in messages.
        image_size: see `downscale`.

    Raises:
        RefusedError: the image has another format, or one channel.
        OSError, SyntaxError, ValueError, DecompressionBombError: the image is damaged, or larger
            than Pillow's limit.
    """
    try:
        image = Image.open(io.BytesIO(file), formats=_FORMATS)
    except UnidentifiedImageError as error:
        start = bytes(file[:8])
        raise RefusedError(f"{what} is neither PNG nor JPEG: it begins with {start}") from error
    with image:
        if image.width * image.height > (Image.MAX_IMAGE_PIXELS or math.inf):
            raise ValueError(f"an image has more than {Image.MAX_IMAGE_PIXELS} pixels")
        _check_color(image.mode, what)
        ImageOps.exif_transpose(image, in_place=True)  # as Hugging Face's datasets reads it
        return downscale(np.asarray(image.convert("RGB")), image_size)


def check_same_size(image: np.ndarray, first: np.ndarray, path: Path) -> None:
    """Raise RefusedError unless two pictures `[H, W, 3]` of a file have the same size."""
    if image.shape != first.shape:
        sizes = " and ".join(f"{x.shape[1]} x {x.shape[0]}" for x in (first, image))
        raise RefusedError(f"{path} has pictures of several sizes, {sizes}, in one episode")


def _check_color(pixels: str, what: str) -> None:
    """Refuse depth and other images of one channel, given a pixel format of Pillow or FFmpeg."""
    if pixels.partition(";")[0] in _ONE_CHANNEL or pixels.startswith("gray"):
        raise RefusedError(
            f"{what} has one channel, as depth has, not colors: leave its camera out with "
            "--cameras, or --data.cameras in training"
        )


def downscale(image: np.ndarray, image_size: int) -> np.ndarray:
    """Downscale uint8 `[H, W, 3]` to at most `image_size` pixels on the longer side.

    0 means no limit. The filter is bilinear with antialiasing, as in openpi's clients
    (openpi_client/image_tools.py).
    """
    height, width, _ = image.shape
    longest = max(height, width)
    if not image_size or longest <= image_size:
        return image
    size = (max(1, width * image_size // longest), max(1, height * image_size // longest))
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BILINEAR))
