"""Run by the tests in an environment with Hugging Face PEFT, without this project.

python peft_script.py write FOLDER    # adapters that PEFT trains, with their inputs and outputs
python peft_script.py read FOLDER     # the outputs of adapters that this project wrote
"""

import itertools
import pathlib
import sys

import numpy as np
import peft
import torch
from torch import nn

SIZES = (24, 40, 24, 16)
ENDS = ["lin.0", "lin.2"]
LORA = {"r": 4, "lora_alpha": 8, "target_modules": ENDS}
CASES = {
    "lora": peft.LoraConfig(**LORA),
    "rslora": peft.LoraConfig(**LORA, use_rslora=True),
    "dora": peft.LoraConfig(**LORA, use_dora=True),
    "dora_rslora": peft.LoraConfig(**LORA, use_dora=True, use_rslora=True),
    "adalora": peft.AdaLoraConfig(
        init_r=6, target_r=3, lora_alpha=8, target_modules=ENDS, tinit=2, tfinal=4, total_step=12
    ),
    "patterns": peft.LoraConfig(
        r=4,
        lora_alpha=8,
        target_modules="all-linear",
        rank_pattern={"lin.0": 2, r"^lin\.1": 7},
        alpha_pattern={"lin.2": 1},
    ),
    "patterns_rslora": peft.LoraConfig(
        r=4, target_modules=ENDS, use_rslora=True, rank_pattern={"lin.2": 9}
    ),
    "regular_expression": peft.LoraConfig(target_modules=r".*lin\.[12]", exclude_modules=["lin.1"]),
    "gaussian": peft.LoraConfig(**LORA, init_lora_weights="gaussian"),
    "bias_all": peft.LoraConfig(**LORA, bias="all"),
    "bias_lora_only": peft.LoraConfig(**LORA, bias="lora_only"),
    "modules_to_save": peft.LoraConfig(r=3, target_modules=["lin.0"], modules_to_save=["lin.2"]),
    "end_of_a_name": peft.LoraConfig(r=3, target_modules=["lin.0"], modules_to_save=["n.2"]),
    "lookahead": peft.LoraConfig(**LORA, alpha_pattern={r"(?!lin\.2).*\d": 1}),
    "pissa": peft.LoraConfig(**LORA, init_lora_weights="pissa"),
    "olora": peft.LoraConfig(**LORA, init_lora_weights="olora"),
    "loha": peft.LoHaConfig(r=4, target_modules=ENDS),
    "ia3": peft.IA3Config(target_modules=ENDS, feedforward_modules=[]),
    "lora_bias": peft.LoraConfig(**LORA, lora_bias=True),
}
RESIDUAL = ("pissa", "olora")
"""Initializations that change the base; saved as an update of the original base."""


class Net(nn.Module):
    def __init__(self):
        super().__init__()
        self.lin = nn.ModuleList(nn.Linear(*pair) for pair in itertools.pairwise(SIZES))

    def forward(self, x):
        for layer in self.lin[:-1]:
            x = torch.tanh(layer(x))
        return self.lin[-1](x)


def arrays(folder):
    """The base of the tests, and their inputs."""
    net, file = Net(), folder / "base.npz"
    if file.exists():
        stored = np.load(file)
        net.load_state_dict({k: torch.tensor(stored[f"base/{k}"]) for k in net.state_dict()})
        return net, torch.tensor(stored["x"])
    x = torch.randn(32, SIZES[0])
    np.savez(file, x=x.numpy(), **{f"base/{k}": v.numpy() for k, v in net.state_dict().items()})
    return net, x


def trained(model, x, folder):
    """Train some steps, in which AdaLoRA prunes."""
    optimizer = torch.optim.AdamW([p for p in model.parameters() if p.requires_grad], 0.03)
    target = torch.randn(len(x), SIZES[-1])
    for step in range(10):
        optimizer.zero_grad()
        (model(x) - target).square().mean().backward()
        optimizer.step()
        if isinstance(model.base_model, peft.AdaLoraModel):
            model.base_model.update_and_allocate(step)
    return model.eval()


def write(folder):
    torch.manual_seed(0)
    arrays(folder)
    for name, config in CASES.items():
        net, x = arrays(folder)
        model, options = peft.get_peft_model(net, config), {}
        if name in RESIDUAL:
            model.save_pretrained(folder / f"{name}_initial")
            options = {"path_initial_model_for_weight_conversion": folder / f"{name}_initial"}
        trained(model, x, folder)
        y = model(x).detach().numpy()  # saving a conversion changes the model
        model.save_pretrained(folder / name, **options)
        np.savez(folder / f"{name}.npz", y=y)


def read(folder):
    for config in sorted(folder.glob("*/adapter_config.json")):
        net, x = arrays(folder)
        model = peft.PeftModel.from_pretrained(net, config.parent).eval()
        y = model(x).detach().numpy()
        merged = model.merge_and_unload()(x).detach().numpy()
        np.savez(folder / f"{config.parent.name}.npz", y=y, merged=merged)


pathlib.Path(sys.argv[2]).mkdir(exist_ok=True)
{"write": write, "read": read}[sys.argv[1]](pathlib.Path(sys.argv[2]))
