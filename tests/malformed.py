"""Check how untrusted input is refused."""

import traceback
from pathlib import Path

from lorasp_jax.base.files import RefusedError
from tests import ROOT


def check_refusal(error: BaseException, *names: str) -> None:
    """Check that the error is this project's, has one line and names one of `names`."""
    assert type(error) in (ValueError, FileNotFoundError, RefusedError), repr(error)
    raised = Path(traceback.extract_tb(error.__traceback__)[-1].filename)
    assert raised.is_relative_to(ROOT), f"{error!r} was raised in {raised}"
    text = str(error)
    assert "\n" not in text
    assert "Traceback" not in text
    assert any(name in text for name in names), text
