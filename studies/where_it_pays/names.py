"""Names of the policies that are compared."""

STUDY = "where_it_pays"
METHODS = {"lora": "LoRA", "lora_sp": "LoRA-SP"}
WIDE = 64
"""R of the policies whose ranks by layer plans have, and that other cells start from."""
SEEDS = (0, 1, 2)
PILOT_SEED = 1000
RATES = (1e-3, 3e-3, 1e-2)
"""Learning rates up to R = 32, of which pilots choose one per backbone, method and rank."""
WIDE_RATES = (3e-4, 1e-3, 3e-3)
"""Those of larger R, which diverge earlier."""


def cell(backbone: str, method: str, rank: int, seed: int) -> str:
    """Return the name of a policy."""
    return f"{backbone}/{method}/r{rank}/s{seed}"


def pilots(backbone: str, method: str, rank: int) -> tuple[str, ...]:
    """Return the names of the policies whose success decides a learning rate."""
    rates = RATES if rank <= 32 else WIDE_RATES
    return tuple(f"{backbone}/pilot/{method}_r{rank}/{rate}" for rate in rates)


def form(backbone: str, name: str, healed: bool, seed: int) -> str:
    """Return the name of a policy in one of `page.FORMS`."""
    return f"{backbone}/form_{name}/{'healed' if healed else 'made'}/s{seed}"


def sequence(backbone: str, kind: str, order: int, seed: int) -> str:
    """Return the name of a policy of one of `sequence_page.KINDS`."""
    return f"{backbone}/{kind}/o{order}/s{seed}"


def recipe(backbone: str, name: str, seed: int) -> str:
    """Return the name of a policy of one of `page.RECIPES`."""
    return f"{backbone}/recipe_{name}/s{seed}"


def base(backbone: str, kind: str) -> str:
    """Return the name of one of `bases.BASES`."""
    return f"{backbone}/base_{kind}"


def on_base(backbone: str, kind: str, method: str, name: str) -> str:
    """Return the name of a policy on one of `bases.BASES`; `name` is its seed, or a pilot's."""
    return f"{backbone}/{kind}/{method}/{name}"
