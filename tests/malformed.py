"""Check how untrusted input is refused, such as adapters of `Net`."""

import traceback
from pathlib import Path

from flax import nnx

from lorasp_jax.base.files import RefusedError
from tests import ROOT


class Net(nnx.Module):
    """Network with the sizes of the golden PEFT adapter."""

    def __init__(self) -> None:
        sizes = ((24, 40), (40, 24), (24, 16))
        self.lin = nnx.List([nnx.Linear(i, o, rngs=nnx.Rngs(0)) for i, o in sizes])


def check_refusal(error: BaseException, *names: str) -> None:
    """Check that the error is this project's, has one line and names one of `names`."""
    assert type(error) in (ValueError, FileNotFoundError, RefusedError), repr(error)
    raised = Path(traceback.extract_tb(error.__traceback__)[-1].filename)
    assert raised.is_relative_to(ROOT), f"{error!r} was raised in {raised}"
    text = str(error)
    assert "\n" not in text
    assert "Traceback" not in text
    assert any(name in text for name in names), text
