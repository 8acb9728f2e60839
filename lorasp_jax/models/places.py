"""Files of models wherever they are: on this machine, on Hugging Face's hub, in a bucket."""

import os
import re
import shutil
from pathlib import Path
from typing import Literal

REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
"""A repository's id on the hub, owner/name."""
LEFT_OUT = ("train_state/*", "*.bin", "*.pt", "*.pth", "*.onnx", "*.gguf", "*.msgpack", "*.h5")
"""What nothing here reads: optimizer states, and the same weights for other libraries."""


def local(
    where: str | os.PathLike[str],
    *,
    only: list[str] | None = None,
    repository: Literal["model", "dataset"] = "model",
) -> Path:
    """The file or folder on this machine; it is downloaded first if it is somewhere else.

    Args:
        where: a path; or the id of a repository on the hub, kept in its own cache; or a URL of a
            bucket, gs://bucket/folder, kept below the user's cache folder, lorasp_jax/.
        only: patterns of the files that are wanted from a repository; None: all but `LEFT_OUT`.
        repository: what kind of repository on the hub.

    Raises:
        ValueError: it is not there, or cannot be reached.
    """
    name, path = os.fspath(where), Path(where)
    if path.exists():
        return path
    if "://" in name:
        return _from_bucket(name)
    if REPOSITORY.fullmatch(name):
        return _from_hub(name, only, repository)
    raise ValueError(
        f"{name} does not exist, and is no owner/name on the hub nor gs://bucket/path."
    )


def _from_hub(name: str, only: list[str] | None, repository: str) -> Path:
    import huggingface_hub
    from huggingface_hub.errors import HfHubHTTPError

    try:
        found = huggingface_hub.snapshot_download(
            name, repo_type=repository, allow_patterns=only, ignore_patterns=list(LEFT_OUT)
        )
        return Path(found)
    except (OSError, ValueError, HfHubHTTPError) as error:
        raise ValueError(
            f"there is no folder {name}, and the hub did not give a repository of that name, for "
            f"want of it, of a permission or of a connection ({_first_line(error)})."
        ) from error


def _from_bucket(url: str) -> Path:
    import fsspec

    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "lorasp_jax"
    target = cache / url.rstrip("/").replace("://", "/", 1)
    if target.exists():
        return target
    unfinished = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        store, root = fsspec.core.url_to_fs(url)
        names = [n for n in store.find(root) if "/train_state/" not in n]
        if not names:
            raise FileNotFoundError("there is nothing of that name")
        for name in names:
            file = unfinished / name[len(root.rstrip("/")) :].lstrip("/")
            file.parent.mkdir(parents=True, exist_ok=True)
            store.get_file(name, str(file))
        unfinished.rename(target)
    except Exception as error:  # every store raises its own kinds
        raise ValueError(f"{url} cannot be fetched: {_first_line(error)}.") from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return target


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".partition("\n")[0].rstrip(".")
