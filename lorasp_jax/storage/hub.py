"""Files of models wherever they are: on this machine, on Hugging Face's hub, in a bucket.

Only what begins with hf:// is asked of the hub: a folder that is not there never becomes somebody's
repository of the same name.
"""

import os
import re
import sys
from pathlib import Path
from typing import Any, Literal

from envs.datasets.locks import locked
from envs.datasets.writing import atomic_file, atomic_folder
from lorasp_jax.storage import shipped

HUB = "hf://"
"""How a repository on the hub begins, as in hf://owner/name."""
REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
"""A repository's id on the hub, owner/name."""
BUCKET = re.compile(r"(gs|s3|memory)://[\w.-]+(/[\w.+=@-]+)*/?")
"""A folder or file in a bucket: other URLs may be anything, a web page or a file of this machine's.
In memory (fsspec's) are those of tests."""
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
        where: a path; or a repository on the hub, hf://owner/name, kept in its own cache; or a URL
            of a bucket, gs://bucket/folder, kept below the user's cache folder, lorasp_jax/. A
            shipped base, assets/pi0_nano, is found from any folder.
        only: patterns of the files that are wanted from a repository; None: all but `LEFT_OUT`.
        repository: what kind of repository on the hub.

    Raises:
        ValueError: it is not there, cannot be reached, or is another kind of URL.
    """
    name, path = os.fspath(where), Path(where)
    if name.startswith(HUB):
        return _from_hub(name.removeprefix(HUB), only, repository)
    if "://" in name:
        if not BUCKET.fullmatch(name) or ".." in name.split("/"):
            raise ValueError(f"{name} is no folder in a bucket: that is gs://bucket/folder.")
        return _from_bucket(name)
    for found in (path, shipped.ROOT / path) if _is_shipped(path) else (path,):
        if os.path.exists(found):  # Path.exists raises where a name is too long
            return found
    raise ValueError(_nowhere(name, path))


def lasting(where: str) -> str:
    """A place as it is written down, for `found_again` from any other folder; empty stays empty."""
    if not where or "://" in where:
        return where
    path = Path(where)
    if not os.path.exists(path) and _is_shipped(path):
        return where
    path = path.resolve()
    inside = path.is_relative_to(shipped.ROOT) and _is_shipped(path.relative_to(shipped.ROOT))
    return path.relative_to(shipped.ROOT).as_posix() if inside else str(path)


def found_again(where: str) -> str:
    """What `lasting` wrote down, for `local`: no other folder takes the place of a shipped base."""
    return str(shipped.ROOT / where) if _is_shipped(Path(where)) else where


def _is_shipped(path: Path) -> bool:
    return shipped.is_one(path, shipped.BASES)


def _nowhere(name: str, path: Path) -> str:
    """Why a path leads nowhere, and what else may have been meant."""
    inside = path.relative_to(shipped.ROOT) if path.is_relative_to(shipped.ROOT) else path
    if _is_shipped(inside):
        return shipped.no_base(name)
    if REPOSITORY.fullmatch(name):
        return f"there is no folder {name}; a repository on the hub is written {HUB}{name}"
    return f"{name} does not exist, and is neither {HUB}owner/name on the hub nor gs://bucket/path"


def is_elsewhere(where: str | os.PathLike[str]) -> bool:
    """Whether a place is the hub or a bucket, from which `local` downloads."""
    return "://" in os.fspath(where)


def _from_hub(name: str, only: list[str] | None, repository: str) -> Path:
    if not REPOSITORY.fullmatch(name):
        raise ValueError(f"{HUB}{name} is no repository on the hub: that is {HUB}owner/name.")
    import huggingface_hub
    from huggingface_hub.errors import HfHubHTTPError

    try:
        found = huggingface_hub.snapshot_download(
            name, repo_type=repository, allow_patterns=only, ignore_patterns=list(LEFT_OUT)
        )
        return Path(found)
    except (OSError, ValueError, HfHubHTTPError) as error:
        raise ValueError(
            f"the hub did not give {HUB}{name}, for want of it, of a permission or of a connection "
            f"({_first_line(error)})."
        ) from error


def _from_bucket(url: str) -> Path:
    import fsspec

    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "lorasp_jax"
    target = cache / url.rstrip("/").replace("://", "/", 1)
    waiting = f"another process is fetching {url}: waiting for it"
    try:
        with locked(target, lambda: print(waiting, file=sys.stderr)):
            if not target.exists():
                _fetch(*fsspec.core.url_to_fs(url), target)
    except ImportError as error:  # fsspec's own sentence names the store's package alone
        raise ValueError(f'{url} needs a package: pip install "lorasp_jax[buckets]"') from error
    except Exception as error:  # every store raises its own kinds
        raise ValueError(f"{url} cannot be fetched: {_first_line(error)}.") from error
    return target


def _fetch(store: Any, root: str, target: Path) -> None:
    """Copy a file or folder of a bucket."""
    names = [name for name in store.find(root) if "/train_state/" not in name]
    if not names:
        raise FileNotFoundError("there is nothing of that name")
    is_file = names == [root]
    with (atomic_file if is_file else atomic_folder)(target) as unfinished:
        for name in names:
            file = unfinished if is_file else unfinished / name[len(root) :].lstrip("/")
            file.parent.mkdir(parents=True, exist_ok=True)
            store.get_file(name, str(file))


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".partition("\n")[0].rstrip(".")
