"""Config of online reinforcement learning: that of the start run, and what learning adds."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from lorasp_jax.config import Config
from lorasp_jax.peft import fields


@dataclass(frozen=True)
class Learning:
    """Proximal policy optimization (PPO, arXiv 1707.06347) of a flow policy with Gaussian noise."""

    start: Annotated[str, tyro.conf.arg(name="from", prefix_name=False)] = ""
    """Finished run to start from: its base, robot, adapters and, unless given, tasks. Empty: the
    base in model with new adapters, as `train.py` would start."""
    adapters: Literal["continue", "merge"] = "continue"
    """Train the adapters of the start run, or merge them into its base and train new ones."""
    worlds: int = 64
    """Parallel worlds per task, one episode each in every iteration."""
    std: float = 0.05
    """Standard deviation of exploration [normalized action units]."""
    advantages: Literal["critic", "group"] = "critic"
    """Advantages from a critic on the simulator's full state, which is thrown away after training,
    or relative to the other episodes of the same layout (group, arXiv 2402.03300)."""
    group: int = 8
    """Episodes per layout with group advantages."""
    reward: Literal["sparse", "dense"] = "sparse"
    """1 on success, or that and the progress of the task's stages."""
    discount: float = 0.98
    """Discount per control step."""
    trace: float = 0.95
    """λ of generalized advantage estimation (arXiv 1506.02438)."""
    clip: float = 0.2
    """Largest deviation of the probability ratio of an action from 1 that is rewarded."""
    epochs: int = 2
    """Passes over the chunks of an iteration."""
    max_kl: float = 0.02
    """An iteration ends when an action's mean KL divergence from the policy that acted exceeds
    this."""
    max_start_kl: float = 20.0
    """The run stops when an action's mean KL divergence from the start policy exceeds this."""
    critic_learning_rate: float = 1e-3
    """Learning rate of the critic."""

    def __post_init__(self) -> None:
        fields.check_fields(self)
        for name in ("worlds", "epochs"):
            if getattr(self, name) < 1:
                raise ValueError(f"learn.{name} must be at least 1, got {getattr(self, name)}")
        for name in ("std", "clip", "max_kl", "max_start_kl", "critic_learning_rate"):
            if getattr(self, name) <= 0:
                raise ValueError(f"learn.{name} must be above 0, got {getattr(self, name)}")
        for name in ("discount", "trace"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"learn.{name} must lie in (0, 1], got {getattr(self, name)}")
        if self.advantages == "group" and (self.group < 2 or self.worlds % self.group):
            sizes = f"{self.worlds} and {self.group}"
            raise ValueError(f"learn.worlds must be a multiple of learn.group >= 2, got {sizes}")


@dataclass(frozen=True)
class ReinforceConfig(Config):
    """One run of online reinforcement learning; a step is an iteration of rollout and update.

    `optim.batch_size` are the chunks of a gradient step.
    """

    learn: Learning = field(default_factory=Learning)
    """What is learned, and how."""
