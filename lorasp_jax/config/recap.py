"""Settings of advantage-conditioned learning (RECAP, arXiv 2511.14759)."""

from dataclasses import dataclass

from lorasp_jax.peft.fields import at_least, check_fields, require


@dataclass(frozen=True)
class RecapConfig:
    """Which actions count as good, and how the policy is told."""

    steps: int = 10
    """Control steps whose effect on the value is an action's advantage."""
    share: float = 0.3
    """Share of a task's steps with the highest advantage, which count as good; demonstrations and
    corrections always do."""
    dropout: float = 0.3
    """Share of the steps that the policy learns without being told which are good."""

    def check(self, learn: str, recorded: bool) -> None:
        """Raise ValueError unless `Config.learn` fits these settings and whether data is given."""
        if learn != "imitation" and not recorded:
            raise ValueError(f"learn {learn} needs recordings with outcomes: add data.source")
        if learn != "recap" and self != RecapConfig():
            raise ValueError(f"recap has settings, which learn {learn} ignores: add learn recap")

    def __post_init__(self) -> None:
        check_fields(self)
        at_least(1, self, "steps", prefix="recap.")
        require(0 < self.share < 1, "recap.share must lie in (0, 1)", self.share)
        require(0 <= self.dropout < 1, "recap.dropout must lie in [0, 1)", self.dropout)
