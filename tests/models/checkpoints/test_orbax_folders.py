"""What Orbax is given, and what it says."""

import asyncio
import logging
import os
import sys
from types import SimpleNamespace

import pytest

from lorasp_jax.models.checkpoints import orbax_folders


@pytest.mark.parametrize(
    ("name", "size", "sentence"),
    [
        ("manifest.ocdbt", 2**30 + 1, "manifest.ocdbt must have at most .* bytes, got 1073741825"),
        ("d/0123", 2**43, "0123 would take .* GiB of memory"),
        ("pipe", None, "pipe must be a file, but is a pipe"),
    ],
)
def test_what_would_end_this_process(name, size, sentence, tmp_path):
    path = tmp_path / "state" / name
    path.parent.mkdir(parents=True)
    os.mkfifo(path) if size is None else path.touch()
    if size:
        os.truncate(path, size)  # a hole: takes no place
    with pytest.raises(ValueError, match=sentence):
        orbax_folders.check(tmp_path)
    path.unlink()
    orbax_folders.check(tmp_path)


def test_of_a_failed_write_only_its_own_error_is_said(monkeypatch, caplog):
    """Threads that are still at it find the loop closed; tasks that failed were left alone."""
    said = []
    monkeypatch.setattr(sys, "unraisablehook", said.append)
    orbax_folders._filter_unraisable_errors.__wrapped__()
    orbax_folders.suppress_repeated_errors()
    loop = asyncio.new_event_loop()
    loop.close()
    read = compile("1 / 0", "x/orbax/path.py", "exec")
    for call in (lambda: loop.call_soon_threadsafe(print), lambda: exec(read), lambda: int("x")):
        try:
            call()
        except Exception as error:
            frames = error.__traceback__.tb_next.tb_next  # of a thread of C++, Python's alone
            sys.unraisablehook(SimpleNamespace(exc_value=error, exc_traceback=frames))
    assert [str(each.exc_value)[:7] for each in said] == ["invalid"]
    for place in ("x/orbax/path.py", "ours.py"):
        try:
            exec(compile("1 / 0", place, "exec"))
        except ZeroDivisionError:
            logging.getLogger("asyncio").exception("never retrieved")
    assert ["ours.py" in (record.exc_text or "") for record in caplog.records] == [True]
