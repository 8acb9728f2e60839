"""Processes that must not outlive the one that started them."""

import multiprocessing
import os
import threading


def end_with_parent() -> None:
    """Let a process of `multiprocessing` exit at once when its parent has gone, even if killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
