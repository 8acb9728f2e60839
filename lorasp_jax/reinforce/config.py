"""Config of online reinforcement learning: that of the start run, and what learning adds."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from lorasp_jax.config import Config
from lorasp_jax.peft.fields import at_least, check_fields, require


@dataclass(frozen=True)
class Learning:
    """How a flow policy learns from success in simulation.

    By proximal policy optimization (PPO, arXiv 1707.06347) with a critic, exploring by Gaussian
    noise: of the policy itself, of a teacher for each task that the policy then imitates, or of the
    initial noise of the flow.
    """

    start: Annotated[str, tyro.conf.arg(name="from", prefix_name=False)] = ""
    """Finished run to start from: its base, robot, adapters and, unless given, tasks. Empty: the
    base in model with new adapters, as `train.py` would start."""
    adapters: Literal["continue", "merge"] = "continue"
    """Train the adapters of the start run, or merge them into its base and train new ones."""
    method: Literal["teacher", "ppo", "noise"] = "teacher"
    """Who learns from success: a small policy on the simulator's state, the adapters, or an actor
    that chooses the initial noise of the flow, while the policy stays as it is."""
    worlds: int = 64
    """Parallel worlds per task, each for one time limit in every iteration."""
    std: float = 0.1
    """Standard deviation of exploration [normalized action units]; with noise, the share that all
    actions of a chunk have in common, below 1."""
    correlation: float = 0.9
    """Correlation of this noise in successive actions of a chunk; 0: new noise in each."""
    exploration: Literal["actions", "sde"] = "actions"
    """Where ppo adds noise: to the actions that the flow returns, or in one random step of the flow
    (Flow-SDE, arXiv 2510.25889)."""
    noise_level: float = 0.5
    """Standard deviation of the noise of sde in the first of K flow steps, at most 1; in the last,
    it is that over √(K (K - 1)) [normalized action units]."""
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
    max_kl: float = 0.1
    """A step that brings the mean KL divergence per action from the policy that acted above this
    is the last of its iteration, or of a teacher's round. The learning rate adapts to end near
    it."""
    max_start_kl: float = 100.0
    """The run stops when the mean KL divergence per executed action from the start policy exceeds
    this. An offset by 1.1 of the 7 slots of 5 actions is 102 with the default noise."""
    critic_learning_rate: float = 1e-3
    """Learning rate of the critic."""
    teacher_worlds: int = 256
    """Parallel worlds in which a teacher practises; they need no pictures."""
    teacher_learning_rate: float = 1e-4
    """Learning rate of a teacher; it adapts to max_kl."""
    rounds: int = 5
    """Time limits in which a teacher practises before the policy imitates it again."""
    gradient_steps: int = 100
    """Gradient steps in which the policy imitates its teachers in an iteration."""
    minutes: float = 0.0
    """Start no iteration after this time [min]; 0: no limit."""

    def __post_init__(self) -> None:
        check_fields(self)
        at_least(1, self, "worlds", "epochs", "rounds", "gradient_steps", prefix="online.")
        rates = "critic_learning_rate", "teacher_learning_rate"
        for name in ("std", "clip", "max_kl", "max_start_kl", *rates):
            value = getattr(self, name)
            require(value > 0, f"online.{name} must be above 0", value)
        for name in ("discount", "trace", "noise_level"):
            value = getattr(self, name)
            require(0 < value <= 1, f"online.{name} must lie in (0, 1]", value)
        # A quarter of them measures success.
        at_least(8, self, "teacher_worlds", prefix="online.")
        rule = "online.correlation must lie in [0, 1)"
        require(0 <= self.correlation < 1, rule, self.correlation)
        if self.method == "noise" and self.std >= 1:
            raise ValueError(f"online.std must be below 1 for noise, got {self.std}")
        if self.exploration == "sde" and self.method != "ppo":
            raise ValueError(f"online.exploration sde is for ppo, not for {self.method}")
        at_least(0, self, "minutes", prefix="online.")


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

    `optim.batch_size` are the chunks of a gradient step. Without teachers, the learning
    rate adapts to the KL divergence of the iterations, and the first trains only the critic.
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
        if self.online.method != "teacher" and self.optim.steps == 1:
            raise ValueError(
                "optim.steps must be at least 2, got 1: the first iteration trains only the critic"
            )
        if self.online.exploration == "sde" and (count := self.evaluation.denoise_steps) < 2:
            raise ValueError(f"evaluation.denoise_steps must be at least 2 for sde, got {count}")
        super().__post_init__()

    def evaluates(self, step: int) -> bool:
        """Whether to evaluate after an iteration: as the config says, and after the last one."""
        return step == self.optim.steps or super().evaluates(step)
