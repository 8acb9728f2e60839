"""Config of flow distillation: that of the start run, and what is distilled."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from lorasp_jax.config import Config
from lorasp_jax.models.sampling import NUM_STEPS
from lorasp_jax.peft import fields


@dataclass(frozen=True)
class Distillation:
    """What the policy of a finished run learns from itself."""

    start: Annotated[str, tyro.conf.arg(name="from", prefix_name=False)] = ""
    """Finished run to start from, which decides all but optimizer and evaluation."""
    loss: Literal["endpoint", "snapflow"] = "endpoint"
    """Where 10 flow steps of the start policy end (endpoint), or SnapFlow's self-distillation to
    one step (snapflow)."""

    def __post_init__(self) -> None:
        fields.check_fields(self)


@dataclass(frozen=True)
class DistillFlowConfig(Config):
    """One run of flow distillation, to `evaluation.denoise_steps` flow steps.

    Unless given, batch size, accumulation and 0.3 times the learning rate are the start run's.
    """

    distill: Distillation = field(default_factory=Distillation)
    """What is distilled."""
    keep: Literal["best", "last"] = "last"
    """See `Config`. The least action error would favor the mean of what demonstrations do."""

    def __post_init__(self) -> None:
        steps = self.evaluation.denoise_steps
        if steps >= NUM_STEPS:
            raise ValueError(
                f"evaluation.denoise_steps must be below {NUM_STEPS}, the flow steps that are "
                f"distilled, got {steps}"
            )
        if self.distill.loss == "snapflow" and steps > 1:
            raise ValueError(
                f"distill.loss snapflow learns one flow step: evaluation.denoise_steps is {steps}"
            )
        if self.optim.rtc_max_delay:
            raise ValueError("optim.rtc_max_delay is not for flow distillation: drop it")
        super().__post_init__()
