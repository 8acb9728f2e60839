"""Config of online reinforcement learning: that of the start run, and what learning adds."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from lorasp_jax.config import Config, OptimConfig
from lorasp_jax.peft import fields


@dataclass(frozen=True)
class Learning:
    """How a flow policy learns from its own episodes, in which Gaussian noise explores."""

    start: Annotated[str, tyro.conf.arg(name="from", prefix_name=False)] = ""
    """Finished run to start from: its base, robot, adapters and, unless given, tasks. Empty: the
    base in model with new adapters, as `train.py` would start."""
    adapters: Literal["continue", "merge"] = "continue"
    """Train the adapters of the start run, or merge them into its base and train new ones."""
    method: Literal["imitate", "ppo"] = "imitate"
    """Imitate the policy's own successful episodes by its flow-matching loss, or proximal policy
    optimization with a critic (ppo, arXiv 1707.06347)."""
    worlds: int = 64
    """Parallel worlds per task, one episode each in every iteration."""
    std: float = 0.05
    """Standard deviation of exploration [normalized action units]."""
    reward: Literal["sparse", "dense"] = "sparse"
    """1 on success, or that and the progress of the task's stages."""
    discount: float = 0.98
    """Discount per control step."""
    trace: float = 0.95
    """λ of generalized advantage estimation (arXiv 1506.02438)."""
    clip: float = 0.2
    """Largest deviation of the probability ratio of an action from 1 that is rewarded."""
    epochs: int = 8
    """Passes over the chunks of an iteration."""
    max_kl: float = 0.02
    """An iteration ends when an action's mean KL divergence from the policy that acted exceeds
    this."""
    max_start_kl: float = 300.0
    """The run stops when an action's mean KL divergence from the start policy exceeds this."""
    critic_learning_rate: float = 1e-3
    """Learning rate of the critic."""

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


@dataclass(frozen=True)
class ReinforceConfig(Config):
    """One run of online reinforcement learning; a step is an iteration of rollout and update.

    `optim.batch_size` are the chunks of a gradient step.
    """

    online: Learning = field(default_factory=Learning)
    """What is learned, and how."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("accumulate", "ema"):
            if getattr(self.optim, name) != getattr(OptimConfig, name):
                raise ValueError(f"optim.{name} is not for reinforcement learning: drop it")

    def evaluates(self, step: int) -> bool:
        """Whether to evaluate after an iteration: as the config says, and after the last one."""
        return step == self.optim.steps or super().evaluates(step)
