"""What a run is: frozen dataclasses, one instance per experiment file in `configs/`."""

import math
from dataclasses import dataclass, field
from typing import Literal

from lorasp_jax.peft import Method, _fields

SCALES = ("smoke", "cpu", "accelerator")
LONGEST_NAME = 200
"""Bytes of a run's name; file systems take 255, and the name of a run's lock is longer."""


def _at_least(low: int, owner: object, *names: str) -> None:
    """Raise ValueError unless these fields are at least so much."""
    for name in names:
        if getattr(owner, name) < low:
            raise ValueError(f"{name} must be at least {low}, got {getattr(owner, name)}")


def _check_name(name: str) -> None:
    """Raise ValueError unless it is that of a folder inside another one."""
    plain = name not in ("", ".", "..") and "/" not in name and name.isprintable()
    if not plain or len(name.encode()) > LONGEST_NAME:
        raise ValueError(
            f"name must be a plain folder name of at most {LONGEST_NAME} bytes, got {name!r}"
        )


@dataclass(frozen=True)
class ModelConfig:
    """The backbone and its base weights."""

    backbone: str = "pi0"
    """pi0 or smolvla."""
    size: str = "nano"
    """nano for a CPU, small for one accelerator, base as published; of pi0 also nano_pi05 and
    base_pi05."""
    checkpoint: str = "assets/{backbone}_{size}"
    """Where the base weights are: a folder, hf://owner/name, a bucket; empty for random ones.
    Shipped bases are found from any folder. {backbone} and {size} stand for those fields."""
    tokenizer: str = ""
    """A SentencePiece .model or tokenizer.json, a file or hf://owner/name; empty: the offline one
    of nano and small."""
    max_tokens: int = 0
    """Longest instruction [tokens]; 0: what the size has."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the matrix products."""
    param_dtype: Literal["float32", "bfloat16"] = "float32"
    """Type the base is stored in; adapters are float32."""
    relative_actions: bool = False
    """Joint targets relative to the state a chunk starts from, as openpi trained pi0."""
    remat: Literal["auto", "none", "products", "full"] = "auto"
    """What the backward pass computes again to save memory: nothing, all but matrix products, or
    all inside a layer; auto is the first of these that fits into the device."""
    unroll: bool | None = None
    """Layers as straight-line code, not as a loop: faster steps of the same memory, but a longer
    compilation; None: unless remat is full."""

    @property
    def source(self) -> str:
        """`checkpoint` with the names filled in."""
        return self.checkpoint.replace("{backbone}", self.backbone).replace("{size}", self.size)

    def __post_init__(self) -> None:
        """Checks the fields."""
        _fields.check_fields(self)
        _at_least(0, self, "max_tokens")


@dataclass(frozen=True)
class DataConfig:
    """Demonstrations: made by the scripted expert, or a dataset."""

    source: str = ""
    """A dataset in place of the expert: LeRobot (folder or hf://owner/name), RLDS, or a cache
    (python -m lorasp_jax.data convert); it says robot and tasks. Empty: the expert."""
    episodes: int = 512
    """Successful demonstrations per task."""
    num_envs: int = 256
    """Worlds simulated at a time while collecting."""
    action_noise: float = 0.005
    """Standard deviation of the noise on executed joint targets [rad]; recorded ones are clean."""
    fresh_every: int = 0
    """Steps after which as many other demonstrations take the place of the old, collected on the
    device while these train; a multiple of log_every. 0: the same throughout."""

    def __post_init__(self) -> None:
        """Checks the numbers."""
        _fields.check_fields(self)
        _at_least(1, self, "episodes", "num_envs")
        _at_least(0, self, "action_noise", "fresh_every")
        if self.fresh_every and self.source:
            raise ValueError("a dataset has no fresh demonstrations: leave out data.fresh_every")


@dataclass(frozen=True)
class OptimConfig:
    """AdamW with linear warm-up and cosine decay."""

    steps: int = 2000
    """Optimizer steps."""
    batch_size: int = 512
    """Windows per step, over all devices."""
    learning_rate: float = 1e-3
    """Peak learning rate."""
    final_learning_rate: float = 1e-5
    """Learning rate at the last step."""
    warmup_steps: int = 100
    """Steps of linear warm-up from zero."""
    weight_decay: float = 1e-4
    """Decoupled weight decay."""
    b2: float = 0.95
    """Decay of the second moment."""
    clip_norm: float = 1.0
    """Largest global gradient norm."""
    accumulate: int = 1
    """Parts of a batch that a step takes one after the other, to need less memory; the task loss is
    that of the whole batch, the auxiliary ones are means over the parts."""
    ema: float = 0.0
    """Decay a step of the moving average of what trains, which is then what is evaluated and
    exported, such as 0.999; 0: no average."""
    state_noise: float = 0.02
    """Standard deviation of the noise on normalised robot states while training."""
    max_skipped: int = 10
    """Steps in a row whose loss or gradient is not finite, or a spike, before the run stops."""
    spike: float = 0.0
    """Skip a step whose loss or gradient norm is beyond this factor times its running mean; 0: only
    one that is not finite."""

    def __post_init__(self) -> None:
        """Checks the numbers."""
        _fields.check_fields(self)
        _at_least(1, self, "steps", "batch_size", "accumulate", "max_skipped")
        _at_least(0, self, "learning_rate", "final_learning_rate", "warmup_steps")
        _at_least(0, self, "weight_decay", "state_noise")
        if self.clip_norm <= 0:
            raise ValueError(f"clip_norm must be above 0, got {self.clip_norm}")
        if not 0 <= self.b2 < 1:
            raise ValueError(f"b2 must lie in [0, 1), got {self.b2}")
        if self.spike and not 1 < self.spike < math.inf:
            raise ValueError(f"spike must be 0 or more than 1, got {self.spike}")
        if not 0 <= self.ema < 1:
            raise ValueError(f"ema must lie in [0, 1), got {self.ema}")


@dataclass(frozen=True)
class AuxiliaryConfig:
    """Weights of the auxiliary losses, eq. 14 of arXiv 2603.07404."""

    spectral: float = 1e-2
    """Weight of the spectral loss 1 - E_k, eq. 13."""
    balance: float = 1e-3
    """Weight of the balance loss."""
    z: float = 1e-3
    """Weight of the router z-loss."""
    orthogonality: float = 0.1
    """Weight of AdaLoRA's orthogonality penalty, eq. 4 of arXiv 2303.10512."""
    warmup: float = 0.02
    """Share of the steps over which the weights rise linearly from zero."""

    def __post_init__(self) -> None:
        """Checks the numbers."""
        _fields.check_fields(self)
        _at_least(0, self, "spectral", "balance", "z", "orthogonality")
        if not 0 <= self.warmup <= 1:
            raise ValueError(f"warmup must lie in [0, 1], got {self.warmup}")


@dataclass(frozen=True)
class EvaluationConfig:
    """Closed-loop evaluation in simulation."""

    episodes: int = 256
    """Episodes per task."""
    num_envs: int = 256
    """Worlds simulated at a time."""
    execute_steps: int = 5
    """Actions of a chunk that are executed before the policy looks again."""
    denoise_steps: int = 10
    """Euler steps of the flow-matching sampler."""
    every: int = 0
    """Steps between evaluations while training, at the log line that follows, each in num_envs
    episodes a task; 0: only before and after."""

    @property
    def worlds(self) -> int:
        """Worlds that are simulated at a time."""
        return min(self.episodes, self.num_envs)

    def __post_init__(self) -> None:
        """Checks the numbers."""
        _fields.check_fields(self)
        _at_least(1, self, "episodes", "num_envs", "execute_steps", "denoise_steps")
        if self.every < 0:
            raise ValueError(f"evaluation.every must be at least 0, got {self.every}")
        if self.episodes % self.worlds:
            raise ValueError(
                f"episodes must be a multiple of num_envs, got {self.episodes} and {self.num_envs}"
            )


@dataclass(frozen=True)
class Config:
    """One experiment: robot, tasks, base, adapter method and how to train."""

    name: str
    """The run's folder is runs/<name>."""
    scale: str
    """Which sizes were chosen: smoke, cpu or accelerator."""
    peft: Method
    """Adapter method and its settings."""
    model: ModelConfig = field(default_factory=ModelConfig)
    """Backbone and base weights."""
    robot: str = "piper"
    """Robot the demonstrations are made with and the policy is evaluated on."""
    tasks: tuple[str, ...] = ("open_pot", "pour", "press", "pick_place")
    """Tasks trained together; the default are the paper's four."""
    targets: tuple[str, ...] = (".*",)
    """What the method is attached to: presets (paper, all-linear, openpi, expert-only, vision,
    language, action) and regular expressions of layers' paths."""
    image_size: int = 64
    """Height and width of the simulated cameras' pictures [pixels]; a backbone resizes them."""
    data: DataConfig = field(default_factory=DataConfig)
    """Demonstrations."""
    optim: OptimConfig = field(default_factory=OptimConfig)
    """Optimizer and schedule."""
    auxiliary: AuxiliaryConfig = field(default_factory=AuxiliaryConfig)
    """Auxiliary loss weights."""
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    """Evaluation in simulation."""
    control_dt: float = 0.1
    """Seconds between two actions; demonstrations and base must agree."""
    fsdp: int = 1
    """Devices over which large arrays are split: the base's, and what trains with its optimizer's
    state, if that is as large; the rest of the mesh is data parallel."""
    log_every: int = 50
    """Steps per compiled call, and between log lines."""
    checkpoint_every: int = 1000
    """Steps between checkpoints."""
    seed: int = field(default=0, metadata={"most": 2**32 - 1})
    """Seed of every random stream of the run."""

    def evaluates(self, step: int) -> bool:
        """Whether the policy is evaluated at the log line after so many steps, not the last."""
        every, before = self.evaluation.every, step - self.log_every
        return bool(every) and step // every > before // every and step < self.optim.steps

    def __post_init__(self) -> None:
        """Checks what no single field shows."""
        _fields.check_fields(self)
        _fields.check_fields(self.peft, "peft.")
        _check_name(self.name)
        _at_least(1, self, "fsdp", "log_every", "checkpoint_every", "image_size")
        if self.control_dt <= 0 or not 0 <= self.seed < 2**32:
            raise ValueError(
                f"control_dt must be above 0 and seed in 0 to 2**32 - 1, got {self.control_dt} "
                f"and {self.seed}"
            )
        if self.data.fresh_every % self.log_every:
            raise ValueError(
                f"data.fresh_every must be a multiple of log_every, got {self.data.fresh_every} "
                f"and {self.log_every}"
            )
        if not self.tasks or len(set(self.tasks)) < len(self.tasks):
            raise ValueError(f"tasks must be different and at least one, got {self.tasks}")
