"""Hugging Face PEFT's LoRA and DoRA (PyTorch) on single dense layers.

The layer is bf16, its adapters f32. Both passes run under bf16 autocast, as in mixed-precision
training; without it, PEFT would multiply by the adapters in f32.
"""

from collections.abc import Iterator
from typing import Any

import torch  # pyright: ignore[reportMissingImports]

from benchmarks.peers import torch_device, worker, workloads
from benchmarks.peers.worker import Job, Row

PACKAGES = ("peft", "torch")


def adapted(kernel: Any, rank: int, job: Job) -> Any:
    """Return a frozen layer with the kernel `[I, O]` and an adapter of scale 2."""
    import peft  # pyright: ignore[reportMissingImports]

    layer = torch.nn.Linear(*kernel.shape, bias=False, dtype=torch.bfloat16)
    layer.weight.data.copy_(torch.from_numpy(kernel).T)
    config = peft.LoraConfig(
        r=rank, lora_alpha=2 * rank, target_modules=["0"], use_dora=job.variant == "DoRA"
    )
    model = peft.get_peft_model(torch.nn.Sequential(layer).to(torch_device.device()), config)
    return torch.compile(model) if job.compile else model


def measure(job: Job) -> Iterator[Row]:
    """Yield two rows per shape: the forward pass, and both passes."""
    sizes = workloads.LAYERS[job.size]
    for shape in sizes.shapes:
        drawn = workloads.layer_arrays(shape, sizes.tokens)
        model = adapted(drawn[1], sizes.rank, job)
        x, gradient = (
            torch.from_numpy(array).to(torch_device.device(), torch.bfloat16)
            for array in (drawn[0], drawn[2])
        )
        x.requires_grad_()
        trained = [x, *(p for p in model.parameters() if p.requires_grad)]

        def forward(model: Any = model, x: Any = x) -> torch.Tensor:
            with torch_device.autocast(True):
                return model(x)

        def inference(forward: Any = forward) -> torch.Tensor:
            with torch.no_grad():
                return forward()

        def both(forward: Any = forward, trained: Any = trained, gradient: Any = gradient) -> Any:
            return torch.autograd.grad(forward(), trained, gradient)

        name = "x".join(map(str, shape))
        yield worker.timed(f"{name} forward", inference, torch_device.wait, job)
        yield worker.timed(f"{name} both", both, torch_device.wait, job)


if __name__ == "__main__":
    worker.main(measure, torch_device.name, PACKAGES)
