"""Speed of the data pipeline: windows/s from the cache, time to first batch, LeRobot import.

    python -m benchmarks.data --json data.json
    python -m benchmarks.data --steps 50000 --batches 500     # 16 GB

A window is one training sample: images of two cameras and 50 actions. Windows are shuffled. The
import reads synthetic two-camera recordings in LeRobot's encoding (AV1 or H.264, a key frame every
2 frames). Images keep their size or are resized to 224 pixels, as published models expect. For
comparison, the decoder runs alone, with one video per core. The accelerator is not used.
"""

import argparse
import collections
import itertools
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console

from benchmarks.measuring import machine, print_table, write_json
from envs.datasets.episodes import Episodes
from lorasp_jax.data import cache
from lorasp_jax.data.lerobot import Keys, LeRobot
from lorasp_jax.data.stream import Stream
from lorasp_jax.policies.statistics import Statistics

CAMERAS, CHUNK, FPS = ("side", "wrist"), 50, 30
EPISODE = 250  # steps
HEIGHT, WIDTH = 480, 640
CODECS = {"AV1": "libsvtav1", "H.264": "libx264"}
"""Codec -> name of its encoder in PyAV."""


class Noise:
    """A source of random episodes, generated when they are read."""

    kind, cameras, control_dt = "noise", CAMERAS, 1 / FPS

    def __init__(self, steps: int, height: int, width: int) -> None:
        self.num_steps, self._rng = steps, np.random.default_rng(0)
        self._size = (1, EPISODE, height, width, 3)
        self.left_out: dict[str, str] = {}

    def __len__(self) -> int:
        return self.num_steps // EPISODE

    def episode(self, number: int, cameras: Any = None) -> Episodes:  # noqa: ARG002
        """Generate an episode."""
        normal = self._rng.standard_normal
        state, action = (normal((1, EPISODE, 7), np.float32) for _ in range(2))
        return Episodes(
            image={name: self._rng.integers(0, 255, self._size, np.uint8) for name in CAMERAS},
            state=state,
            action=action,
            length=np.array([EPISODE], np.int32),
            instruction=np.zeros(1, np.int32),
            instructions=("do it",),
            task="noise",
            robot="piper",
            control_dt=self.control_dt,
            physics_dt=0.0,
            attempted=1,
        )


def seconds(call: Callable[[], Any]) -> float:
    """Time a single call."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def read_cache(folder: Path, steps: int, size: tuple[int, int], batch: int, batches: int) -> Any:
    """Measure windows/s, and the time from opening the folder to the first batch."""
    path = folder / f"{size[0]}x{size[1]}"
    if not path.exists():
        cache.write([Noise(steps, *size)], path, lambda *_: None)
    start = time.perf_counter()
    stream = Stream(cache.Cache(path).steps, batch_size=batch, chunk=CHUNK, seed=0)
    next(stream)
    first = time.perf_counter() - start
    duration = seconds(lambda: collections.deque(itertools.islice(stream, batches), maxlen=1))
    pixels = f"{size[1]}x{size[0]}"
    rate = batch * batches / duration
    return {"images": pixels, "batch": batch, "windows/s": rate, "first batch s": first}


def record(folder: Path, episodes: int, codec: str) -> None:
    """Write a LeRobot 2.1 dataset, whose episodes repeat one video per camera."""
    rng, lines = np.random.default_rng(0), []
    for number in range(episodes):
        state, action = (rng.standard_normal((EPISODE, 7), np.float32) for _ in range(2))
        frames = np.arange(EPISODE)
        rows = {"observation.state": list(state), "action": list(action)}
        rows |= {"frame_index": frames, "timestamp": frames / FPS}
        rows |= {"episode_index": [number] * EPISODE, "task_index": [0] * EPISODE}
        table = folder / f"data/chunk-000/episode_{number:06d}.parquet"
        table.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(rows), table)
        lines.append(json.dumps({"episode_index": number, "length": EPISODE}))
    for camera in CAMERAS:
        videos = folder / "videos/chunk-000" / camera
        videos.mkdir(parents=True)
        first, *others = (videos / f"episode_{number:06d}.mp4" for number in range(episodes))
        encode(first, rng, codec)
        for other in others:
            shutil.copyfile(first, other)
    vector, video = {"dtype": "float32", "shape": [7]}, {"dtype": "video", "shape": []}
    features = {"observation.state": vector, "action": vector, **dict.fromkeys(CAMERAS, video)}
    path = "chunk-{episode_chunk:03d}/"
    info = {"codebase_version": "v2.1", "fps": FPS, "robot_type": "piper", "features": features}
    info |= {"chunks_size": 1000, "data_path": f"data/{path}episode_{{episode_index:06d}}.parquet"}
    info |= {"video_path": f"videos/{path}{{video_key}}/episode_{{episode_index:06d}}.mp4"}
    meta = folder / "meta"
    meta.mkdir()
    (meta / "info.json").write_text(json.dumps(info))
    (meta / "tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": "do it"}))
    (meta / "episodes.jsonl").write_text("\n".join(lines))


def encode(path: Path, rng: np.random.Generator, codec: str) -> None:
    """Encode a moving object on a background with LeRobot's settings: yuv420p, g 2, crf 30."""
    os.environ.setdefault("SVT_LOG", "1")  # errors only: the AV1 encoder prints a banner
    scene, patch = texture(rng, HEIGHT, WIDTH), texture(rng, HEIGHT // 2, WIDTH // 4)
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(CODECS[codec], rate=FPS)
        stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, "yuv420p"
        stream.options = {"g": "2", "crf": "30"} | ({"preset": "12"} if codec == "AV1" else {})
        for number in range(EPISODE):
            image = scene.copy()
            y, x = int(120 + 100 * np.cos(number / 20)), int(240 + 200 * np.sin(number / 15))
            image[y : y + patch.shape[0], x : x + patch.shape[1]] = patch
            image += 2 * rng.standard_normal((HEIGHT, WIDTH, 1), np.float32)  # sensor noise
            pixels = image.clip(0, 255).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())


def texture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Generate an image, f32 `[H, W, 3]`, with detail at all scales; 13 kB as AV1 at 640 x 480."""
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width))
    frequency[0, 0] = np.inf
    noise = np.fft.fft2(rng.standard_normal((4, height, width))) / frequency**1.6
    gray, *colors = (layer / layer.std() for layer in np.fft.ifft2(noise).real)
    return (128 + 45 * (gray[..., None] + 0.3 * np.stack(colors, -1))).astype(np.float32)


def import_dataset(folder: Path, codec: str, image_size: int) -> dict[str, Any]:
    """Measure steps/s and images/s of importing a LeRobot dataset into a cache."""
    source = LeRobot(folder / codec, Keys(image_size=image_size))
    target = folder / f"imported_{codec}_{image_size}"
    rate = source.num_steps / seconds(lambda: cache.write([source], target, lambda *_: None))
    side, _ = cache.Cache(target).cameras.values()
    size, images = f"{side[1]}x{side[0]}", len(CAMERAS) * rate
    return {"codec": codec, "stored as": size, "steps/s": rate, "images/s": images}


def decode(folder: Path, codec: str) -> dict[str, Any]:
    """Measure images/s of the decoder alone, an upper bound for the import."""
    videos = sorted((folder / codec).rglob("*.mp4"))

    def run(video: Path) -> int:
        with av.open(str(video)) as container:
            return sum(1 for _ in container.decode(video=0))

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        start = time.perf_counter()
        images = sum(pool.map(run, videos))
        rate = images / (time.perf_counter() - start)
    size = sum(video.stat().st_size for video in videos) / images / 1000
    return {"codec": codec, "kB/image": size, "decoded/s": rate}


def statistics(steps: int) -> dict[str, Any]:
    """Time the computation of normalization statistics over `steps` steps."""
    rows = np.random.default_rng(0).standard_normal((steps, 7), np.float32)
    valid = np.ones(steps, bool)
    call = lambda: Statistics.measure(rows, rows, valid, slots=range(7), dim=7)  # noqa: E731
    return {"steps": float(steps), "statistics s": seconds(call)}


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--steps", type=int, default=5000, help="steps in the cache (%(default)s)")
    parser.add_argument("--batches", type=int, default=200, help="batches to time (%(default)s)")
    parser.add_argument("--episodes", type=int, default=4, help="episodes to import (%(default)s)")
    parser.add_argument("--json", type=Path, help="file for the results")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        read = [
            read_cache(folder, options.steps, size, batch, options.batches)
            for size in ((128, 128), (168, 224))
            for batch in (32, 256)
        ]
        for codec in CODECS:
            record(folder / codec, options.episodes, codec)
        imported = [import_dataset(folder, codec, size) for codec in CODECS for size in (0, 224)]
        decoded = [decode(folder, codec) for codec in CODECS]
    tables = {"cache": read, f"LeRobot {WIDTH}x{HEIGHT}": imported, "decoder": decoded}
    tables["statistics"] = [statistics(1_000_000)]
    name = machine("numpy", "grain", "av")
    console = Console()
    console.print(name)
    for title, rows in tables.items():
        print_table(console, rows, title)
    write_json(options.json, {"machine": name, **tables})


if __name__ == "__main__":
    main()
