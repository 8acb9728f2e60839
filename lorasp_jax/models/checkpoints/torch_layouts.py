"""Layout rules for the parts of PyTorch policies that are named as in Hugging Face Transformers.

PyTorch stores a linear layer as a matrix [O, I]. Ours are [I, O], stacked to [L, I, O] in towers.
"""

from collections.abc import Iterable, Sequence

from lorasp_jax.models.checkpoints.layouts import Rule, copied, stacked, transposed
from lorasp_jax.models.config import VisionConfig

PROJECTIONS = (
    "state_proj",
    "action_in_proj",
    "action_time_mlp_in",
    "action_time_mlp_out",
    "action_out_proj",
)
"""Projections outside the towers of pi0 and SmolVLA. Their names are the same in all published
layouts and here."""


def linear(ours: str, theirs: str) -> list[Rule]:
    """Rules for a linear layer with a bias."""
    return [
        transposed(f"{ours}/kernel", f"{theirs}.weight"),
        copied(f"{ours}/bias", f"{theirs}.bias"),
    ]


def siglip(theirs: str, size: VisionConfig) -> list[Rule]:
    """Rules for our `vision` tower, except its head."""
    patches, norm = f"{theirs}.embeddings.patch_embedding", f"{theirs}.post_layernorm"
    rules = [
        _patches("vision/patch_embed/kernel", f"{patches}.weight", size),
        copied("vision/patch_embed/bias", f"{patches}.bias"),
        copied("vision/position_embedding", f"{theirs}.embeddings.position_embedding.weight"),
        copied("vision/norm/scale", f"{norm}.weight"),
        copied("vision/norm/bias", f"{norm}.bias"),
    ]
    layers = [f"{theirs}.encoder.layers.{i}" for i in range(size.depth)]
    attention = (f"self_attn.{name}_proj" for name in ("q", "k", "v", "out"))
    for name in (*attention, "mlp.fc1", "mlp.fc2"):
        rules += [_stacked("vision/blocks", layers, name, leaf) for leaf in ("kernel", "bias")]
    for name in ("layer_norm1", "layer_norm2"):
        rules += [_stacked("vision/blocks", layers, name, leaf) for leaf in ("scale", "bias")]
    return rules


def decoder(ours: str, theirs: str, layers: Iterable[int], *, adaptive: bool = False) -> list[Rule]:
    """Rules that stack some layers of a Llama or Gemma model.

    Args:
        ours: path of our stack.
        theirs: path of their module.
        layers: indices of their layers that form the stack.
        adaptive: whether the norms are pi0.5's adaptive norms.
    """
    paths = [f"{theirs}.layers.{i}" for i in layers]
    attention = (f"self_attn.{name}_proj" for name in "qkvo")
    kernels = (*attention, "mlp.gate_proj", "mlp.up_proj", "mlp.down_proj")
    rules = [_stacked(ours, paths, name, "kernel") for name in kernels]
    for name in ("input_layernorm", "post_attention_layernorm"):
        if adaptive:
            leaves = ("kernel", "bias")
            rules += [_stacked(f"{ours}/{name}", paths, f"{name}.dense", leaf) for leaf in leaves]
        else:
            rules.append(_stacked(ours, paths, name, "scale"))
    return rules


def _patches(ours: str, theirs: str, size: VisionConfig) -> Rule:
    """Rule for the patch embedding: their kernel `[O, rgb, y, x]`, our matrix `[y x rgb, O]`."""
    patch = size.patch
    return Rule(
        (ours,),
        (theirs,),
        lambda _: [(size.width, 3, patch, patch)],
        lambda arrays: [w.transpose(2, 3, 1, 0).reshape(-1, len(w)) for w in arrays],
        lambda kernel: [kernel.reshape(patch, patch, 3, -1).transpose(3, 2, 0, 1)],
    )


def _stacked(ours: str, layers: Sequence[str], name: str, leaf: str) -> Rule:
    """Rule for one leaf ("kernel", "scale" or "bias") of a module of all layers."""
    names = [f"{layer}.{name}.{'bias' if leaf == 'bias' else 'weight'}" for layer in layers]
    return stacked(f"{ours}/{name.rpartition('.')[2]}/{leaf}", names, transpose=leaf == "kernel")
