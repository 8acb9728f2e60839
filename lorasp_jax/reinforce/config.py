"""Config of online reinforcement learning: that of the start run, and what learning adds."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from lorasp_jax.config import Config
from lorasp_jax.peft import fields


@dataclass(frozen=True)
class Learning:
    """How a flow policy learns from its own episodes, in which Gaussian noise explores.

    By proximal policy optimization (PPO, arXiv 1707.06347) with a critic.
    """

    start: Annotated[str, tyro.conf.arg(name="from", prefix_name=False)] = ""
    """Finished run to start from: its base, robot, adapters and, unless given, tasks. Empty: the
    base in model with new adapters, as `train.py` would start."""
    adapters: Literal["continue", "merge"] = "continue"
    """Train the adapters of the start run, or merge them into its base and train new ones."""
    worlds: int = 64
    """Parallel worlds per task, one episode each in every iteration."""
    std: float = 0.1
    """Standard deviation of exploration [normalized action units]."""
    correlation: float = 0.9
    """Correlation of this noise in successive actions of a chunk; 0: new noise in each."""
    reward: Literal["sparse", "dense"] = "sparse"
    """1 on success, or that and the progress of the task's stages."""
    discount: float = 0.997
    """Discount per control step."""
    trace: float = 0.99
    """λ of generalized advantage estimation (arXiv 1506.02438)."""
    clip: float = 0.2
    """Largest deviation of the probability ratio of an action from 1 that is rewarded."""
    epochs: int = 4
    """Passes over the chunks of an iteration."""
    max_kl: float = 0.02
    """A step that brings the mean KL divergence per action from the policy that acted above this
    is the last of its iteration. The learning rate adapts to end iterations near it."""
    max_start_kl: float = 20.0
    """The run stops when the mean KL divergence per executed action from the start policy exceeds
    this. An offset by 0.5 of the 7 slots of 5 actions is 21 with the default noise."""
    critic_learning_rate: float = 1e-3
    """Learning rate of the critic."""
    minutes: float = 0.0
    """Start no iteration after this time [min]; 0: no limit."""

    def __post_init__(self) -> None:
        fields.check_fields(self)
        for name in ("worlds", "epochs"):
            if getattr(self, name) < 1:
                raise ValueError(f"online.{name} must be at least 1, got {getattr(self, name)}")
        for name in ("std", "clip", "max_kl", "max_start_kl", "critic_learning_rate"):
            if getattr(self, name) <= 0:
                raise ValueError(f"online.{name} must be above 0, got {getattr(self, name)}")
        for name in ("discount", "trace"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"online.{name} must lie in (0, 1], got {getattr(self, name)}")
        if not 0 <= self.correlation < 1:
            raise ValueError(f"online.correlation must lie in [0, 1), got {self.correlation}")
        if self.minutes < 0:
            raise ValueError(f"online.minutes must be at least 0, got {self.minutes}")


_IGNORED = (
    *("optim.ema", "optim.warmup_steps", "optim.final_learning_rate", "optim.spike"),
    *("optim.state_noise", "optim.time_shape", "optim.rtc_max_delay"),
    *("recap.steps", "recap.share", "recap.dropout", "learn", "keep", "log_every"),
    *("auxiliary.warmup", "evaluation.before"),  # the start is a candidate for the best policy
)
"""Settings that must keep their defaults."""


@dataclass(frozen=True)
class ReinforceConfig(Config):
    """One run of online reinforcement learning; a step is an iteration of rollout and update.

    `optim.batch_size` are the chunks of a gradient step. The learning rate adapts to the KL
    divergence of the iterations. The first iteration trains only the critic.
    """

    online: Learning = field(default_factory=Learning)
    """What is learned, and how."""
    log_every: int = 1
    """Iterations between log entries."""

    def __post_init__(self) -> None:
        for name in _IGNORED:
            group, _, field_name = name.rpartition(".")
            owner = getattr(self, group) if group else self
            if getattr(owner, field_name) != getattr(type(owner), field_name):
                raise ValueError(f"{name} is not for reinforcement learning: drop it")
        if self.data.source and not self.online.start:
            raise ValueError("data.source is not for reinforcement learning: drop it")
        if self.optim.steps == 1:
            raise ValueError(
                "optim.steps must be at least 2, got 1: the first iteration trains only the critic"
            )
        super().__post_init__()

    def evaluates(self, step: int) -> bool:
        """Whether to evaluate after an iteration: as the config says, and after the last one."""
        return step == self.optim.steps or super().evaluates(step)
