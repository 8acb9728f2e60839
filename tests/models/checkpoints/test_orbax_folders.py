"""Checks before Orbax opens a folder, and suppression of the errors that it repeats."""

import logging
import os

import pytest

from lorasp_jax.models.checkpoints import orbax_folders


@pytest.mark.parametrize(
    ("name", "size", "message"),
    [
        ("d/0123", 2**43, "0123 .* memory"),
        ("pipe", None, "pipe"),
    ],
)
def test_unsafe_files_are_refused(name, size, message, tmp_path):
    path = tmp_path / "state" / name
    path.parent.mkdir(parents=True)
    os.mkfifo(path) if size is None else path.touch()
    if size:
        os.truncate(path, size)  # sparse: takes no disk space
    with pytest.raises(ValueError, match=message):
        orbax_folders.check(tmp_path)
    path.unlink()
    orbax_folders.check(tmp_path)


def test_only_errors_from_elsewhere_are_logged(caplog):
    orbax_folders.suppress_repeated_errors()
    for file in ("x/orbax/path.py", "ours.py"):
        try:
            exec(compile("1 / 0", file, "exec"))
        except ZeroDivisionError:
            logging.getLogger("asyncio").exception("never retrieved")
    assert ["ours.py" in (record.exc_text or "") for record in caplog.records] == [True]
