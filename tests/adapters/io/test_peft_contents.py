"""What PEFT and other tools store beside float32 LoRAs of dense layers: read as PEFT reads it."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.compress import quantization
from lorasp_jax.adapters.io import hugging_face
from lorasp_jax.peft import FullFineTuning, LoRA
from tests.adapters.io.peft_folder import edit_config, edit_tensors, trained

SCALE = 2.0


class Net(nnx.Module):
    """A small language model with a picture encoder, and a layer that adapters do not support."""

    def __init__(self):
        rngs = nnx.Rngs(0)
        self.embed_tokens = nnx.Embed(16, 8, rngs=rngs)
        self.conv = nnx.Conv(3, 5, (2, 4), rngs=rngs)
        self.q_proj = nnx.Linear(8, 8, use_bias=False, rngs=rngs)
        self.action_head = nnx.Sequential(nnx.Linear(8, 4, rngs=rngs))
        self.lm_head = nnx.Linear(8, 16, use_bias=False, rngs=rngs)
        self.own = Own()


class Own(nnx.Module):
    """A class that adapters do not know."""

    def __init__(self):
        self.w = nnx.Param(jnp.ones((8, 8)))


def normal(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def lora(name, d_in, d_out, seed=0):
    """Tensors of a LoRA of rank 2, in torch's layout."""
    prefix = f"base_model.model.{name}.lora_"
    return {f"{prefix}A.weight": normal(2, d_in, seed=seed), f"{prefix}B.weight": normal(d_out, 2)}


def update(tensors, name):
    """Change of a kernel [I, O]."""
    a, b = (tensors[f"base_model.model.{name}.lora_{side}.weight"] for side in "AB")
    return SCALE * (b.astype(np.float32) @ a.astype(np.float32)).T


def write(folder, tensors, **config):
    safetensors.numpy.save_file(tensors, folder / hugging_face.TENSORS)
    config = {"peft_type": "LORA", "r": 2, "lora_alpha": 4} | config
    (folder / hugging_face.CONFIG).write_text(json.dumps(config))
    return folder


def change(model, name):
    """Change of a kernel by loading and merging."""
    after, before = (getattr(net, name).kernel[...] for net in (adaptation.merge(model), Net()))
    return after - before


Q = lora("q_proj", 8, 8)


@pytest.mark.parametrize("dtype", ["bfloat16", "float16", "float8_e4m3fn", "float8_e5m2"])
def test_narrow_types(dtype, tmp_path):
    stored = {name: value.astype(np.dtype(dtype)) for name, value in Q.items()}
    model = hugging_face.load_peft(write(tmp_path, stored), Net())
    assert all(leaf.dtype == jnp.float32 for leaf in model.q_proj.adapter.get_value().values())
    np.testing.assert_allclose(change(model, "q_proj"), update(stored, "q_proj"), atol=1e-5)


def test_integers_are_refused(tmp_path):
    stored = {name: value.astype(np.int8) for name, value in Q.items()}
    with pytest.raises(ValueError, match=r"q_proj\.lora_A\.weight' must be floating-point"):
        hugging_face.load_peft(write(tmp_path, stored), Net())


def test_stored_base_weights_replace_those_of_the_model(tmp_path):
    """save_embedding_layers: PEFT loads them without training them (set_peft_model_state_dict)."""
    table, head = normal(16, 8, seed=1), normal(16, 8, seed=2)
    tensors = Q | lora("lm_head", 8, 16)
    tensors |= {"base_model.model.lm_head.base_layer.weight": head}
    tensors |= {"base_model.model.embed_tokens.weight": table}
    base = Net()
    model = hugging_face.load_peft(write(tmp_path, tensors), base)
    np.testing.assert_array_equal(model.embed_tokens.embedding[...], table)
    np.testing.assert_array_equal(model.lm_head.kernel[...], head.T)
    merged = adaptation.merge(model).lm_head.kernel[...]
    np.testing.assert_allclose(merged, head.T + update(tensors, "lm_head"), atol=1e-5)
    assert adaptation.methods(model).keys() == {"q_proj", "lm_head"}
    assert (base.embed_tokens.embedding[...] != table).any(), "load_peft changed its argument"

    quantized = quantization.quantize(Net(), [("lm_head", "int8")]).model
    with pytest.raises(ValueError, match="replaces lm_head/kernel: quantize after"):
        hugging_face.load_peft(tmp_path, quantized)


def test_tied_output_layers_of_models_that_lack_them(tmp_path):
    table = normal(16, 8, seed=1)
    tied = {f"base_model.model.{name}.weight": table for name in ("embed_tokens", "lm_head")}
    bare = Net()
    del bare.lm_head
    model = hugging_face.load_peft(write(tmp_path, Q | tied), bare)
    np.testing.assert_array_equal(model.embed_tokens.embedding[...], table)
    write(tmp_path, Q | tied | {"base_model.model.lm_head.weight": table + 1})
    with pytest.raises(ValueError, match="weight of 'lm_head', which the model lacks"):
        hugging_face.load_peft(tmp_path, bare)
    write(tmp_path, Q | {"base_model.model.embed_tokens.weight": normal(17, 8)})  # new tokens
    with pytest.raises(ValueError, match=r"embed_tokens/embedding must have shape .*\(17, 8\)"):
        hugging_face.load_peft(tmp_path, bare)


def test_modules_to_save_are_ends_of_names(tmp_path):
    """Also in the middle of a word, and with the modules inside (_set_trainable of 0.21.2)."""
    values = {"weight": normal(4, 8, seed=3), "bias": normal(4)}
    inner = {
        f"base_model.model.action_head.layers.0.{kind}": value for kind, value in values.items()
    }
    model = hugging_face.load_peft(write(tmp_path, Q | inner, modules_to_save=["head"]), Net())
    methods = adaptation.methods(model)
    assert methods.pop("q_proj") == LoRA(rank=2, alpha=4.0)
    paths = [f"action_head/layers/0/{name}" for name in ("bias", "kernel")]
    assert methods == dict.fromkeys(paths, FullFineTuning())
    np.testing.assert_array_equal(model.action_head.layers[0].kernel[...], values["weight"].T)
    model = hugging_face.load_peft(write(tmp_path, Q | inner, modules_to_save=["act"]), Net())
    assert adaptation.methods(model).keys() == {"q_proj"}  # read, but not trained
    np.testing.assert_array_equal(model.action_head.layers[0].bias[...], values["bias"])


def test_loras_of_embeddings_and_convolutions(tmp_path):
    """An embedding's A is [R, V], a convolution's [R, I, *sizes], with a pointwise B."""
    a, b = normal(2, 16, seed=4), normal(8, 2)
    conv_a, conv_b = normal(2, 3, 2, 4, seed=5), normal(5, 2, 1, 1)
    tensors = {
        "base_model.model.embed_tokens.lora_embedding_A": a,
        "base_model.model.embed_tokens.lora_embedding_B": b,
        "base_model.model.conv.lora_A.weight": conv_a,
        "base_model.model.conv.lora_B.weight": conv_b,
    }
    model = hugging_face.load_peft(write(tmp_path, tensors), Net())
    table = Net().embed_tokens.embedding[...] + SCALE * (b @ a).T
    np.testing.assert_allclose(model.embed_tokens(jnp.arange(16)), table, atol=1e-5)
    kernel = SCALE * np.einsum("rihw,or->hwio", conv_a, conv_b[:, :, 0, 0])
    np.testing.assert_allclose(change(model, "conv"), kernel, atol=1e-5)

    hugging_face.save_peft(tmp_path / "again", trained(model))
    again = hugging_face.load_peft(tmp_path / "again", Net())
    np.testing.assert_allclose(change(again, "conv"), change(trained(model), "conv"), atol=1e-5)
    hugging_face.save_peft(tmp_path / "same", model)
    same = safetensors.numpy.load_file(tmp_path / "same" / hugging_face.TENSORS)
    assert same.keys() == tensors.keys()
    for name, value in tensors.items():
        np.testing.assert_array_equal(same[name], value)


def test_adapter_names_in_keys(tmp_path):
    named = {name.replace(".weight", ".default.weight"): value for name, value in Q.items()}
    model = hugging_face.load_peft(write(tmp_path, named), Net())
    np.testing.assert_allclose(change(model, "q_proj"), update(Q, "q_proj"), atol=1e-5)
    other = {
        name.replace(".weight", ".b.weight"): value
        for name, value in lora("lm_head", 8, 16).items()
    }
    with pytest.raises(ValueError, match="several"):
        hugging_face.load_peft(write(tmp_path, named | other), Net())


@pytest.mark.parametrize(
    ("pattern", "matches"),
    [
        ("(?!lm_head).*_proj", True),
        ("(?!q_).*_proj", False),
        (r"\w+_(?:proj|head)", True),
        ("(q|k)_proj|head", True),
        ("[q]+_p.?r{1}oj", True),
    ],
)
def test_patterns_of_peft(pattern, matches, tmp_path):
    model = hugging_face.load_peft(write(tmp_path, Q, alpha_pattern={pattern: 8}), Net())
    assert model.q_proj.method.scale == (4.0 if matches else 2.0)


def test_layers_that_cannot_be_adapted(tmp_path):
    with pytest.raises(ValueError, match=r"'own', .*unsupported classes: own \(Own\)"):
        hugging_face.load_peft(write(tmp_path, Q | lora("own", 8, 8)), Net())


def test_adapters_of_unused_layers_that_never_changed(tmp_path):
    """target_modules="all-linear" also adapts layers without gradients, whose B stays zero."""
    unused = lora("model.pooler", 8, 8)
    unused["base_model.model.model.pooler.lora_B.weight"][:] = 0
    model = hugging_face.load_peft(write(tmp_path, Q | unused), Net())
    assert adaptation.methods(model).keys() == {"q_proj"}
    edit_tensors(tmp_path, lambda tensors: tensors | lora("model.pooler", 8, 8))
    with pytest.raises(ValueError, match=r"'model.pooler'"):
        hugging_face.load_peft(tmp_path, Net())


def test_variants_of_lora_are_refused(tmp_path):
    write(tmp_path, Q)
    for name in ("arrow_config", "kasa_config", "monteclora_config"):
        edit_config(tmp_path, **{name: {"top_k": 3}})
        with pytest.raises(ValueError, match=f"sets {name}"):
            hugging_face.load_peft(tmp_path, Net())
        edit_config(tmp_path, **{name: None})
