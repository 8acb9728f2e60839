"""The README's examples run as they stand."""

import re

import pytest

from tests import ROOT

README = (ROOT / "README.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.mark.parametrize("code", ["\n".join(EXAMPLES[:2])], ids=["your own model"])
def test_example(code, capsys):
    exec(compile(code, "README.md", "exec"), {})
    assert "lora_sp" in capsys.readouterr().out


def test_simulation_examples_compile_as_text():
    assert len(EXAMPLES) == 4
    for code in EXAMPLES[2:]:
        compile(code, "README.md", "exec")
