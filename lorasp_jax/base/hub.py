"""Resolve local paths, Hugging Face Hub repositories and cloud buckets.

Only hf:// paths reach the Hub, so a missing folder never resolves to a repository of the same name.
"""

import contextlib
import importlib
import logging
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from lorasp_jax.base import shipped
from lorasp_jax.base.files import first_line, join_inside
from lorasp_jax.base.locks import locked
from lorasp_jax.base.user_cache import user_cache
from lorasp_jax.base.writing import atomic_file, atomic_folder

HUB = "hf://"
"""URL prefix of Hub repositories, hf://owner/name."""
REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
"""Repository id on the Hub, owner/name."""
BUCKET = re.compile(r"(gs|memory)://[\w.-]+(/[\w.+=@-]+)*/?")
"""URL of a folder or file in a bucket; memory:// is fsspec's in-memory store, for tests."""
IGNORED_PATTERNS = (
    "train_state/*",
    "*.bin",
    "*.pt",
    "*.pth",
    "*.onnx",
    "*.gguf",
    "*.msgpack",
    "*.h5",
)
"""Files not to download from the Hub: optimizer states, and weights in other libraries' formats."""


def local(
    where: str | os.PathLike[str],
    *,
    only: list[str] | None = None,
    repository: Literal["model", "dataset"] = "model",
) -> Path:
    """Return the local path of a file or folder, downloading it if necessary.

    Args:
        where: a path, a Hub repository (hf://owner/name) or a bucket URL (gs://bucket/folder). The
            Hub client caches repositories; buckets are cached in lorasp_jax/ under the user's cache
            folder. Shipped bases, such as assets/pi0_nano, resolve from any working directory.
        only: patterns of the files to download from a Hub repository; None means all.
            `IGNORED_PATTERNS` are always skipped.
        repository: type of the Hub repository.

    Raises:
        ValueError: `where` does not exist, is unreachable, or is an unsupported URL.
        ModuleNotFoundError: gcsfs, which reads gs:// URLs, is not installed.
    """
    name, path = os.fspath(where), Path(where)
    if name.startswith(HUB):
        return _from_hub(name.removeprefix(HUB), only, repository)
    if "://" in name:
        if not BUCKET.fullmatch(name) or ".." in name.split("/"):
            raise ValueError(f"a bucket URL must be gs://bucket/folder, got {name}")
        return _from_bucket(name)
    for candidate in (path, shipped.ROOT / path) if _is_shipped(path) else (path,):
        if os.path.exists(candidate):  # Path.exists raises if a name is too long
            return candidate
    raise ValueError(_not_found_message(name, path))


def portable_path(where: str) -> str:
    """Return a path that `resolve_portable` resolves from any working directory; "" stays ""."""
    if not where or "://" in where:
        return where
    path = Path(where)
    if not os.path.exists(path) and _is_shipped(path):
        return where
    path = path.resolve()
    inside = path.is_relative_to(shipped.ROOT) and _is_shipped(path.relative_to(shipped.ROOT))
    return path.relative_to(shipped.ROOT).as_posix() if inside else str(path)


def resolve_portable(where: str) -> str:
    """Resolve a recorded path for `local`; shipped bases take precedence over local folders."""
    return str(shipped.ROOT / where) if _is_shipped(Path(where)) else where


def _is_shipped(path: Path) -> bool:
    return shipped.is_under(path, shipped.BASES)


def _not_found_message(name: str, path: Path) -> str:
    inside = path.relative_to(shipped.ROOT) if path.is_relative_to(shipped.ROOT) else path
    if _is_shipped(inside):
        found = sorted(file.parent.name for file in shipped.ROOT.glob("assets/*/config.json"))
        return f"{name} does not exist; bases in {shipped.ROOT / shipped.BASES}: {', '.join(found)}"
    if REPOSITORY.fullmatch(name):
        return f"{name} does not exist; for a Hub repository, pass {HUB}{name}"
    return f"{name} does not exist; pass a path, {HUB}owner/name or gs://bucket/path"


def is_remote(where: str | os.PathLike[str]) -> bool:
    """Return whether `where` is a URL that `local` downloads."""
    return "://" in os.fspath(where)


def _from_hub(name: str, only: list[str] | None, repository: str) -> Path:
    if not REPOSITORY.fullmatch(name):
        raise ValueError(f"a Hub repository must be {HUB}owner/name, got {HUB}{name}")
    import huggingface_hub
    from huggingface_hub.errors import HfHubHTTPError

    try:
        folder = huggingface_hub.snapshot_download(
            name, repo_type=repository, allow_patterns=only, ignore_patterns=list(IGNORED_PATTERNS)
        )
        return Path(folder)
    except (OSError, ValueError, HfHubHTTPError) as error:
        raise ValueError(
            f"cannot download {HUB}{name}: not found, access denied, or no connection "
            f"({first_line(error)})"
        ) from error


def _from_bucket(url: str) -> Path:
    import fsspec

    target = user_cache() / url.rstrip("/").replace("://", "/", 1)
    waiting = f"waiting: another process is downloading {url}"
    try:
        with locked(target, lambda: print(waiting, file=sys.stderr)):
            if not target.exists():
                if url.startswith("gs://"):  # fsspec would report its absence in its own words
                    importlib.import_module("gcsfs")
                with _one_report():
                    _copy(*fsspec.core.url_to_fs(url), target)
    except ModuleNotFoundError:
        raise
    except Exception as error:  # each backend raises its own errors
        raise ValueError(f"cannot download {url}: {first_line(error)}") from error
    return target


@contextlib.contextmanager
def _one_report() -> Iterator[None]:
    """Keep gcsfs from printing a traceback of each error that it also raises."""
    logger = logging.getLogger("gcsfs")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def _copy(store: Any, root: str, target: Path) -> None:
    """Copy a file or folder from a bucket, without optimizer states."""
    names = [name for name in store.find(root) if "/train_state/" not in name]
    if not names:
        raise FileNotFoundError("no such file or folder")
    is_file = names == [root]
    with (atomic_file if is_file else atomic_folder)(target) as unfinished:
        for name in names:
            file = unfinished if is_file else join_inside(unfinished, name[len(root) :].lstrip("/"))
            file.parent.mkdir(parents=True, exist_ok=True)
            store.get_file(name, str(file))
