"""What is compared: per table, programs and their variants in the order in which they run.

The first entry of a table is the reference of its ratios, and runs again at the end.
"""

import dataclasses

OURS = "ours"


@dataclasses.dataclass(frozen=True)
class Case:
    """One process.

    Attributes:
        table: cases that do the same work.
        program: a module of this package.
        variant: what the program does, as its module names it.
    """

    table: str
    program: str
    variant: str


TABLES: dict[str, tuple[tuple[str, str], ...]] = {
    "pi0-train": (
        (OURS, "LoRA-SP"),
        (OURS, "openpi's LoRA"),
        ("openpi", "LoRA"),
        ("openpi", "LoRA without augmentation"),
    ),
    "pi0-sample": ((OURS, "none"), (OURS, "LoRA-SP"), ("openpi", "none")),
    "smolvla-train": (
        (OURS, "LoRA-SP"),
        (OURS, "LoRA"),
        ("lerobot", "LoRA"),
        ("lerobot", "LoRA, autocast"),
    ),
    "smolvla-expert": (
        (OURS, "expert only"),
        ("lerobot", "expert only"),
        ("lerobot", "expert only, autocast"),
    ),
    "smolvla-sample": ((OURS, "none"), (OURS, "LoRA-SP"), ("lerobot", "none")),
    "layer-lora": ((OURS, "LoRA"), (OURS, "LoRA-SP"), ("peft", "LoRA")),
    "layer-dora": ((OURS, "DoRA"), ("peft", "DoRA")),
    "stack": ((OURS, "LoRA"), (OURS, "LoRA-SP"), ("qwix", "LoRA")),
    "stack-nf4": ((OURS, "LoRA on nf4"), (OURS, "LoRA-SP on nf4"), ("qwix", "LoRA on nf4")),
}
INSTALL = {
    OURS: "pip install -e .",
    "openpi": "pip install --no-deps git+https://github.com/Physical-Intelligence/openpi@15a9616a "
    "&& pip install jax flax optax orbax-checkpoint safetensors torch augmax einops "
    "beartype==0.19.0 jaxtyping==0.2.36",
    "lerobot": 'pip install "lerobot[smolvla,peft]==0.6.1"',
    "qwix": "pip install qwix==0.1.8",
    "peft": "pip install torch peft",
}
"""Program -> the command that installs it into its environment."""


def cases(tables: list[str], *, once: bool = False) -> list[Case]:
    """List the processes in the order in which they run; `once` omits the repeated references."""
    chosen = []
    for table in tables:
        entries = [Case(table, program, variant) for program, variant in TABLES[table]]
        chosen += entries if once else [*entries, entries[0]]
    return chosen
