"""Adapt the published pi0 (3.2 B parameters) to the PiPER arm: four tasks, LoRA-SP, rank 128.

    python train.py --config configs/multitask_pi0.py
    python train.py --config configs/multitask_pi0.py --model.checkpoint FOLDER \\
        --model.tokenizer FILE

Weights and tokenizer are downloaded from public buckets unless you pass your own; weights may be in
openpi's or LeRobot's layout. `--fit 24GB` fits the run to a GPU; with more memory it recomputes
less and trains faster. `--fsdp N` shards the base over N devices. The third of pi0's camera slots
is masked.
"""

from lorasp_jax.config import Config, DataConfig, EvaluationConfig, ModelConfig, OptimConfig
from lorasp_jax.peft import LoRASP


def get_config(scale: str) -> Config:
    """Return the config; smoke runs a few steps at full model size."""
    smoke = scale == "smoke"
    return Config(
        name="multitask_pi0",
        scale=scale,
        peft=LoRASP(rank=128),
        model=ModelConfig(
            size="base",
            checkpoint="gs://openpi-assets/checkpoints/pi0_base",
            tokenizer="gs://big_vision/paligemma_tokenizer.model",
            dtype="bfloat16",
            param_dtype="bfloat16",
            relative_actions=True,
        ),
        targets=("paper",),
        image_size=224,
        data=DataConfig(episodes=4 if smoke else 120, num_envs=4 if smoke else 60),
        optim=OptimConfig(
            steps=4 if smoke else 20_000,
            batch_size=4 if smoke else 32,
            learning_rate=1e-4,
            final_learning_rate=1e-6,
            warmup_steps=1 if smoke else 500,
            state_noise=0.0,
        ),
        evaluation=EvaluationConfig(
            episodes=4 if smoke else 64,
            num_envs=4 if smoke else 16,
            execute_steps=25,
            denoise_steps=10,  # its authors' number; fewer were measured only at small sizes
        ),
        log_every=2 if smoke else 100,
        checkpoint_every=2 if smoke else 2000,
    )
