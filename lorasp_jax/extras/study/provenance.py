"""Where and from which code a result was made."""

import datetime
import functools
import hashlib
import importlib.metadata
import subprocess
from pathlib import Path

import jax

import envs
import lorasp_jax

_PACKAGES = ("jax", "flax", "mujoco")


def provenance() -> dict[str, str]:
    """Return device, versions, code and date of a result that is finished now.

    `code` is a digest of this package's source files, which exists without a repository, and
    `commit` the repository's, with a plus sign if files differ from it; empty without one.
    """
    return {**_machine(), **_code(), "date": datetime.datetime.now(datetime.UTC).date().isoformat()}


@functools.cache
def _machine() -> dict[str, str]:
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in _PACKAGES)
    return {"device": jax.devices()[0].device_kind, "versions": versions}


@functools.cache
def _code() -> dict[str, str]:
    digest = hashlib.sha256()
    roots = [Path(package.__file__ or "").parent for package in (lorasp_jax, envs)]
    for root in roots:
        for file in sorted(root.rglob("*.py")):
            digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return {"code": digest.hexdigest()[:16], "commit": _commit(roots[0])}


def _commit(folder: Path) -> str:
    """Return the commit of the repository that holds a folder, or an empty text."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        if not git("ls-files", "__init__.py"):  # installed within the repository of something else
            return ""
        return git("rev-parse", "--short=12", "HEAD") + "+" * bool(git("status", "--porcelain"))
    except (OSError, subprocess.CalledProcessError):
        return ""
