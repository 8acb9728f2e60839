"""Experiment config as frozen dataclasses; files in `configs/` return a `Config` per scale."""

from dataclasses import dataclass, field
from typing import Literal

from envs.scene.ranges import Randomization
from lorasp_jax.config.augment import AugmentConfig
from lorasp_jax.config.recap import RecapConfig
from lorasp_jax.peft import Method
from lorasp_jax.peft.auxiliary import AUXILIARY_WEIGHTS
from lorasp_jax.peft.fields import at_least, check_fields, require
from lorasp_jax.peft.plan import RankPlan

SCALES = ("smoke", "cpu", "accelerator")
VALIDATION_WINDOWS = 16
"""Windows of held-out episodes that are measured at once."""
MAX_NAME_BYTES = 200
"""Maximum length of a run name [bytes]. File systems allow 255; the run's lock file adds a few."""


def _check_name(name: str) -> None:
    """Raise ValueError unless `name` is a single path component."""
    valid = name not in ("", ".", "..") and "/" not in name and name.isprintable()
    rule = f"name must be a printable folder name of at most {MAX_NAME_BYTES} bytes without '/'"
    require(valid and len(name.encode()) <= MAX_NAME_BYTES, rule, repr(name))


@dataclass(frozen=True)
class ModelConfig:
    """Backbone and base weights."""

    backbone: str = "pi0"
    """A folder of `lorasp_jax/models`, such as pi0 or smolvla."""
    size: str = "nano"
    """nano for a CPU, small for one accelerator, medium without bundled weights, base for the
    published size; pi0 also has nano_pi05 and base_pi05."""
    checkpoint: str = "assets/{backbone}_{size}"
    """Base weights: a folder, hf://owner/name or a bucket URL; empty: random initialization.
    {backbone} and {size} are replaced by those fields. Bundled bases (assets/...) resolve from any
    working directory."""
    tokenizer: str = ""
    """SentencePiece .model or tokenizer.json: a file, hf://owner/name or a bucket URL; empty: the
    bundled tokenizer of the nano and small sizes."""
    max_tokens: int = 0
    """Maximum instruction length [tokens]; 0: the default of the model size."""
    chunk: int = 0
    """Actions per predicted chunk; 0: as the checkpoint says, or the model size's default."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Compute dtype of matrix products."""
    param_dtype: Literal["float32", "bfloat16"] = "float32"
    """Storage dtype of the base parameters; adapters are always float32."""
    base_dtype: Literal["", "float8", "int8", "nf4"] = ""
    """Quantize the matrices of the three towers: 8 bits per weight (float8, int8) or 4.5 (nf4). On
    NVIDIA GPUs since Ada and Hopper, large matrix products are then in float8 too. Empty: keep
    them in param_dtype."""
    openpi_config: str = ""
    """Training config of an openpi checkpoint, such as pi05_libero, whose chunk, relative actions,
    prompts and units are then kept; none: those of the size; empty: the config that the folder is
    named after."""
    relative_actions: bool | None = None
    """Learn joint targets relative to the state at the start of the chunk, but for grippers; None:
    as the base was trained, if it says so."""
    remat: Literal["auto", "none", "products", "narrow", "full"] = "auto"
    """Rematerialization: the backward pass recomputes nothing (none), everything except matrix
    products (products) or narrow ones (narrow), or the whole layer (full); auto: the first that
    fits in device memory."""
    unroll: bool | None = None
    """Unroll the scan over layers: faster steps in the same memory, slower compilation; None:
    unroll unless remat is full."""

    @property
    def source(self) -> str:
        """`checkpoint` with its placeholders filled in."""
        return self.checkpoint.replace("{backbone}", self.backbone).replace("{size}", self.size)

    def __post_init__(self) -> None:
        check_fields(self)
        at_least(0, self, "max_tokens", "chunk")


@dataclass(frozen=True)
class DataConfig:
    """Training data: demonstrations of the scripted expert, or a dataset."""

    source: tuple[str, ...] = ()
    """Datasets to train on, which then also set robot and tasks: LeRobot (folder or
    hf://owner/name), RLDS, a cache, or a TOML file with a dataset's options (python -m
    lorasp_jax.data inspect --save). Empty: collect demonstrations with the scripted expert."""
    weights: tuple[float, ...] = ()
    """Relative share of the windows drawn from each dataset; empty: its number of windows."""
    replay: float = 0.0
    """Share of the windows drawn from what the base was taught: the last dataset, which is not
    validated on and has no weight, or, without datasets, the other tasks of a base made here."""
    statistics: Literal["shared", "each"] = "shared"
    """Normalize by statistics over all datasets, or each by its own; the policy then acts for the
    first, or for one that is named when it is loaded."""
    cameras: tuple[str, ...] = ()
    """Cameras of the dataset to use, in the order of the backbone's; the last part of a dotted
    name is enough. Empty: all, by name."""
    episodes: int = 512
    """Successful demonstrations per task."""
    num_envs: int = 256
    """Parallel worlds during collection."""
    action_noise: float = 0.005
    """Standard deviation of the noise added to executed joint targets [rad]; recorded actions are
    noise-free."""
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    """Random changes of training images."""
    validation: tuple[str, ...] = ("auto",)
    """Episodes to measure on instead of training: a share such as 0.1, a number, or names such as
    episode_3; auto: a tenth of recordings with at least 10 episodes, none of simulated ones."""
    fresh_every: int = 0
    """Replace all demonstrations every N steps with new ones, which the device collects while it
    trains; a multiple of log_every. 0: never."""

    def __post_init__(self) -> None:
        given = self.source if isinstance(self.source, list | tuple) else (self.source,)
        object.__setattr__(self, "source", tuple(filter(None, given)))
        check_fields(self)
        at_least(1, self, "episodes", "num_envs")
        at_least(0, self, "action_noise", "fresh_every")
        require(0 <= self.replay < 1, "data.replay must lie in [0, 1)", self.replay)
        require(min(self.weights, default=1) > 0, "data.weights must be above 0", self.weights)
        if not self.source and self.validation not in (("auto",), ("0",)):
            raise ValueError("data.validation holds episodes of a dataset out: add data.source")
        if self.fresh_every and (name := "source" if self.source else "replay" * bool(self.replay)):
            raise ValueError(f"data.fresh_every cannot be combined with data.{name}: drop one")
        of_datasets = {"cameras": self.cameras, "weights": self.weights}
        of_datasets["statistics"] = self.statistics == "each"
        if not self.source and (name := next((k for k, x in of_datasets.items() if x), "")):
            raise ValueError(f"data.{name} are those of a dataset: name it with data.source")


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
    """Final learning rate."""
    warmup_steps: int = 100
    """Steps of linear warm-up from zero."""
    weight_decay: float = 1e-4
    """Decoupled weight decay."""
    b2: float = 0.95
    """Decay of the second moment."""
    clip_norm: float = 1.0
    """Gradients are clipped to this global norm."""
    accumulate: int = 1
    """Gradient-accumulation micro-batches per step; a larger number saves memory. The task loss is
    that of the full batch; auxiliary losses are averaged over micro-batches."""
    ema: float = 0.0
    """Per-step decay of the exponential moving average (EMA) of the trainable parameters, such as
    0.999; the average is then evaluated and exported. 0: no average."""
    state_noise: float = 0.02
    """Standard deviation of the noise added to normalized robot states during training."""
    time_shape: float = 1.5
    """a of the Beta(a, 1) distribution of flow times; larger values favor noise."""
    rtc_max_delay: int = 0
    """Train for execution under latency (training-time real-time chunking): the first d actions of
    each chunk are given, d uniform in 0, ..., this number of control steps. 0: none are."""
    max_skipped: int = 10
    """Stop after skipping this many consecutive steps (loss or gradient non-finite or spiking)."""
    spike: float = 0.0
    """Skip a step whose loss or gradient norm exceeds this multiple of its running mean; 0: skip
    only non-finite steps."""

    def __post_init__(self) -> None:
        check_fields(self)
        at_least(1, self, "steps", "batch_size", "accumulate", "max_skipped")
        at_least(0, self, "learning_rate", "final_learning_rate", "warmup_steps")
        at_least(0, self, "weight_decay", "state_noise", "rtc_max_delay")
        for name in ("clip_norm", "time_shape"):
            require(getattr(self, name) > 0, f"{name} must be above 0", getattr(self, name))
        require(0 <= self.b2 < 1, "b2 must lie in [0, 1)", self.b2)
        require(not self.spike or self.spike > 1, "spike must be 0 or more than 1", self.spike)
        require(0 <= self.ema < 1, "ema must lie in [0, 1)", self.ema)


@dataclass(frozen=True)
class AuxiliaryConfig:
    """Weights of the auxiliary losses, eq. 14 of arXiv 2603.07404."""

    spectral: float = AUXILIARY_WEIGHTS["spectral"]
    """Weight of the spectral loss 1 - E_k, eq. 13."""
    balance: float = AUXILIARY_WEIGHTS["balance"]
    """Weight of the balance loss."""
    z: float = AUXILIARY_WEIGHTS["z"]
    """Weight of the router z-loss."""
    orthogonality: float = AUXILIARY_WEIGHTS["orthogonality"]
    """Weight of AdaLoRA's orthogonality penalty, eq. 4 of arXiv 2303.10512."""
    warmup: float = 0.02
    """Fraction of the steps over which the weights rise linearly from zero."""

    def __post_init__(self) -> None:
        check_fields(self)
        at_least(0, self, *AUXILIARY_WEIGHTS)
        require(0 <= self.warmup <= 1, "warmup must lie in [0, 1]", self.warmup)


@dataclass(frozen=True)
class EvaluationConfig:
    """Closed-loop evaluation in simulation."""

    episodes: int = 256
    """Episodes per task."""
    num_envs: int = 256
    """Parallel worlds per task."""
    execute_steps: int = 5
    """Actions executed from each predicted chunk (execution horizon)."""
    denoise_steps: int = 5
    """Euler steps of the flow-matching sampler; the finished run is served with as many."""
    before: bool = True
    """Evaluate the base before training."""
    validate_every: int = 500
    """Steps between measurements on held-out episodes, rounded up to a multiple of log_every. Each
    is on up to 256 windows, or 64 unless the scale is accelerator."""
    every: int = 0
    """Steps between evaluations during training, rounded up to the next log step; each runs
    num_envs episodes per task. 0: do not evaluate during training."""

    @property
    def worlds(self) -> int:
        """Number of parallel worlds: `num_envs`, or `episodes` if that is smaller."""
        return min(self.episodes, self.num_envs)

    def __post_init__(self) -> None:
        check_fields(self)
        at_least(1, self, "episodes", "num_envs", "execute_steps", "denoise_steps")
        at_least(1, self, "validate_every")
        at_least(0, self, "every")
        counts = f"{self.episodes} and {self.num_envs}"
        rule = "episodes must be a multiple of num_envs"
        require(self.episodes % self.worlds == 0, rule, counts)


@dataclass(frozen=True)
class Config:
    """One experiment: robot, tasks, base, adapter method and training settings."""

    name: str
    """Name of the run; its folder is runs/<name>."""
    scale: str
    """Size preset: smoke, cpu or accelerator."""
    peft: Method
    """Adapter method and its settings."""
    model: ModelConfig = field(default_factory=ModelConfig)
    """Backbone and base weights."""
    robot: str = "piper"
    """Robot for demonstrations and evaluation: a name, or the path of an MJCF file (.xml)."""
    tasks: tuple[str, ...] = ("open_pot", "pour", "press", "pick_place")
    """Tasks trained jointly; default: the paper's four."""
    targets: tuple[str, ...] = (".*",)
    """Layers to adapt: presets (paper, all-linear, openpi, expert-only, vision, language, action,
    projections) and regular expressions over layer paths."""
    plan: RankPlan | None = None
    """Ranks by layer for the method in peft, which must be of fixed rank; None: all layers have
    that of the method."""
    adapt: tuple[str, ...] = ()
    """Methods by rule, the first match wins; replaces targets. A rule is TARGET=METHOD[:RANK], such
    as language=lora:16, with one target and a method or none; or a recipe (paper, openpi-lora,
    vlm-lora+expert-full, expert-only). Rules of the method in peft have its settings, others the
    defaults."""
    protect: str = ""
    """Folder of a finished LoRA-SP run to start from; the directions that it uses stay as they
    are. Empty: start from the base."""
    image_size: int = 64
    """Height and width of simulated camera images [pixels]; the backbone resizes them."""
    scene: Randomization = field(default_factory=Randomization)
    """Ranges, low and high, from which every simulated episode draws its scene: demonstrations and
    evaluation. Equal ends fix a value; the defaults change nothing."""
    data: DataConfig = field(default_factory=DataConfig)
    """Training data."""
    learn: Literal["imitation", "filtered", "recap"] = "imitation"
    """What to learn from recordings: all that was done (imitation); what succeeded or a person
    corrected (filtered); or all, told good from bad by the advantage (recap)."""
    recap: RecapConfig = field(default_factory=RecapConfig)
    """Settings of learn recap."""
    optim: OptimConfig = field(default_factory=OptimConfig)
    """Optimizer and schedule."""
    auxiliary: AuxiliaryConfig = field(default_factory=AuxiliaryConfig)
    """Auxiliary loss weights."""
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    """Evaluation in simulation."""
    control_dt: float = 0.1
    """Control period [s]; must match the dataset or, without one, the base."""
    fsdp: int = 1
    """Devices per FSDP group, over which large arrays (base, trainable parameters, optimizer state)
    are sharded; the rest of the mesh is data parallel."""
    keep: Literal["best", "last"] = "best"
    """Which adapters to evaluate and export after the last step: those with the least error on
    held-out episodes, if there are any, or the last."""
    log_every: int = 50
    """Steps per compiled call and between log entries."""
    checkpoint_every: int = 1000
    """Steps between checkpoints."""
    seed: int = field(default=0, metadata={"max": 2**32 - 1})
    """Seed of every random stream of the run."""

    @property
    def ranges(self) -> Randomization | None:
        """`scene`, or None if it changes nothing: worlds then draw nothing."""
        return self.scene if self.scene.changed() else None

    def evaluates(self, step: int) -> bool:
        """Whether to evaluate when logging `step`; the final evaluation is separate."""
        return step < self.optim.steps and self._due(step, self.evaluation.every)

    def validates(self, step: int) -> bool:
        """Whether to measure on held-out episodes when logging `step`."""
        return step == self.optim.steps or self._due(step, self.evaluation.validate_every)

    def _check_plan(self) -> None:
        if getattr(self.peft, "ranks", ()):
            raise ValueError("peft.ranks are those of a plan: name its file with --plan")
        if self.plan is None:
            return
        self.plan.rules(self.peft)
        require(not self.adapt, "plan and adapt cannot be combined: drop one", self.adapt)
        of, rule = self.plan.backbone, "model.backbone must be the plan's"
        require(of == self.model.backbone, f"{rule}, {of}", self.model.backbone)

    def _due(self, step: int, every: int) -> bool:
        return bool(every) and step // every > (step - self.log_every) // every

    def __post_init__(self) -> None:
        check_fields(self)
        check_fields(self.peft, "peft.")
        check_fields(self.scene, "scene.")
        _check_name(self.name)
        at_least(1, self, "fsdp", "log_every", "checkpoint_every", "image_size")
        require(self.control_dt > 0, "control_dt must be above 0", self.control_dt)
        require(0 <= self.seed < 2**32, "seed must lie in [0, 2**32)", self.seed)
        self.scene.check(self.control_dt)
        self._check_plan()
        self.recap.check(self.learn, bool(self.data.source))
        every, rule = self.data.fresh_every, "data.fresh_every must be a multiple of log_every"
        require(every % self.log_every == 0, rule, f"{every} and {self.log_every}")
        unique = 0 < len(self.tasks) == len(set(self.tasks))
        require(unique, "tasks must be non-empty and unique", self.tasks)
