"""LeRobot's SmolVLA (PyTorch): training with PEFT's LoRA or of the action expert, and sampling.

The policy is built as for training from `smolvla_base`, but with random weights and without
network access: the language model's config is a file, and its processor, whose token ids are never
used, is an empty object.

Weights have the dtypes of `smolvla_base`: bf16 in the towers, f32 in the projections and in the
keys and values of the expert's cross-attention. LoRA adapters are f32, as PEFT creates them.
"""

import os
import tempfile
import types
from collections.abc import Callable, Iterator
from typing import Any

os.environ.setdefault("HF_HUB_OFFLINE", "1")

import torch  # pyright: ignore[reportMissingImports]

from benchmarks.peers import torch_device, worker, workloads
from benchmarks.peers.worker import Job, Row

PACKAGES = ("lerobot", "torch", "transformers", "peft")
AUTOCAST = ", autocast"
"""End of the name of variants whose matrix products all run in bf16."""


def language_model_config(job: Job) -> Any:
    """Return transformers' config of the vision-language model; token ids lie in the vocabulary."""
    from transformers import LlamaConfig, SmolVLMConfig  # pyright: ignore[reportMissingImports]

    sizes = workloads.SMOLVLA_TOWERS[job.size]
    ids = {"bos_token_id": 1, "eos_token_id": 2, "pad_token_id": 2}
    return SmolVLMConfig(
        text_config=LlamaConfig(**sizes["text"], **ids),
        vision_config={**sizes["vision"], "image_size": workloads.SMOLVLA[job.size].image},
        image_token_id=3,
        pad_token_id=2,
        **sizes["model"],
    )


def policy_config(job: Job, folder: str) -> Any:
    """Return LeRobot's config: its defaults, for the common batch."""
    from lerobot.configs.types import (  # pyright: ignore[reportMissingImports]
        FeatureType,
        PolicyFeature,
    )
    from lerobot.policies.smolvla.configuration_smolvla import (  # pyright: ignore[reportMissingImports]
        SmolVLAConfig,
    )

    shape = workloads.SMOLVLA[job.size]
    image = PolicyFeature(FeatureType.VISUAL, (3, shape.image, shape.image))
    return SmolVLAConfig(
        input_features={
            **{f"observation.images.{i}": image for i in range(shape.cameras)},
            "observation.state": PolicyFeature(FeatureType.STATE, (shape.dim,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (shape.dim,))},
        vlm_model_name=folder,
        num_vlm_layers=workloads.SMOLVLA_TOWERS[job.size]["text"]["num_hidden_layers"],
        chunk_size=shape.chunk,
        n_action_steps=shape.chunk,
        max_state_dim=shape.dim,
        max_action_dim=shape.dim,
        resize_imgs_with_padding=(shape.image, shape.image),
        tokenizer_max_length=shape.tokens,
        compile_model=job.compile,
        device=torch_device.device(),
    )


def cast(policy: Any) -> None:
    """Give the weights the dtypes of `smolvla_base`."""
    towers = policy.model.vlm_with_expert.bfloat16()
    for i, layer in enumerate(towers.lm_expert.layers):
        if i % policy.config.self_attn_every_n_layers:
            layer.self_attn.k_proj.float()
            layer.self_attn.v_proj.float()


def create(job: Job) -> Any:
    """Create the policy with random weights on the device."""
    import transformers  # noqa: F401  # pyright: ignore[reportMissingImports]
    from lerobot.policies.smolvla import (  # pyright: ignore[reportMissingImports]
        modeling_smolvla,
        smolvlm_with_expert,
    )

    tokenizer = types.SimpleNamespace(fake_image_token_id=0, global_image_token_id=0)
    processor = types.SimpleNamespace(tokenizer=tokenizer)
    smolvlm_with_expert.AutoProcessor = types.SimpleNamespace(from_pretrained=lambda _: processor)
    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as folder:
        language_model_config(job).save_pretrained(folder)
        with torch.device(torch_device.device()):
            policy = modeling_smolvla.SmolVLAPolicy(policy_config(job, folder))
    cast(policy)
    return policy.to(torch_device.device())


def with_lora(policy: Any, rank: int) -> Any:
    """Attach PEFT's LoRA to every linear layer that affects the actions."""
    import peft  # pyright: ignore[reportMissingImports]

    names = [
        name
        for name, module in policy.named_modules()
        if isinstance(module, torch.nn.Linear) and "lm_head" not in name
    ]
    policy.config.pretrained_path = "random"  # LeRobot refuses to adapt untrained policies
    config = peft.LoraConfig(r=rank, lora_alpha=2 * rank, target_modules=names)
    return policy.wrap_with_peft(config)


def inputs(job: Job, size: int) -> dict[str, torch.Tensor]:
    """Return the common batch under LeRobot's names, with images `[B, 3, H, W]` in [0, 1]."""
    batch, device = workloads.policy_batch(workloads.SMOLVLA[job.size], size), torch_device.device()
    images = [torch.from_numpy(x).permute(0, 3, 1, 2) / 2 + 0.5 for x in batch["images"]]
    tensors = {f"observation.images.{i}": image for i, image in enumerate(images)} | {
        "observation.state": torch.from_numpy(batch["state"]),
        "observation.language.tokens": torch.from_numpy(batch["tokens"]).long(),
        "observation.language.attention_mask": torch.ones(batch["tokens"].shape, dtype=torch.bool),
        "action": torch.from_numpy(batch["actions"]),
    }
    return {name: tensor.contiguous().to(device) for name, tensor in tensors.items()}


def training_step(policy: Any, batch: dict[str, torch.Tensor], autocast: bool) -> Callable[[], Any]:
    """Return a function that takes one step as LeRobot's `update_policy` does."""
    trained = [p for p in policy.parameters() if p.requires_grad]
    preset = policy.config.get_optimizer_preset()
    optimizer = preset.build(trained)

    def step() -> float:
        policy.train()
        with torch_device.autocast(autocast):
            loss = policy(dict(batch))[0]
        loss.backward()
        torch.nn.utils.clip_grad_norm_(trained, preset.grad_clip_norm)
        optimizer.step()
        optimizer.zero_grad()
        return loss.item()

    return step


def train(job: Job) -> Iterator[Row]:
    """Time training steps, without data loading and logging."""
    policy, shape = create(job), workloads.SMOLVLA[job.size]
    if job.variant.startswith("LoRA"):
        policy = with_lora(policy, shape.rank)
    count = sum(p.numel() for p in policy.parameters() if p.requires_grad)
    batch = inputs(job, shape.batch)
    step = training_step(policy, batch, job.variant.endswith(AUTOCAST))
    row = worker.timed(f"batch {shape.batch}", step, torch_device.wait, job)
    yield row | {"samples": shape.batch, "trainable": count, "gib": torch_device.peak_gib()}


def sample(job: Job) -> Iterator[Row]:
    """Time sampling, from images to actions."""
    policy = create(job)
    for size in workloads.SMOLVLA[job.size].sampled:
        batch = inputs(job, size)
        del batch["action"]

        def call(batch: dict[str, torch.Tensor] = batch) -> torch.Tensor:
            return policy.predict_action_chunk(dict(batch))

        for steps in job.denoise_steps:
            policy.config.num_steps = steps  # read in every call
            item = worker.sampled(size, steps)
            yield worker.timed(item, call, torch_device.wait, job) | {"samples": size}


def measure(job: Job) -> Iterator[Row]:
    """Yield the rows of one job."""
    yield from (sample if job.table == "smolvla-sample" else train)(job)


if __name__ == "__main__":
    worker.main(measure, torch_device.name, PACKAGES)
