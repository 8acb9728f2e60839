"""Loading and saving Hugging Face PEFT folders, compared with PEFT's own outputs."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import hugging_face
from lorasp_jax.peft import AdaLoRA, DoRA, LoRA
from tests import GOLDEN
from tests.adapters.io.peft_folder import (
    FOLDER,
    Net,
    Stack,
    adapted,
    edit_config,
    edit_tensors,
    reference_net,
    trained,
)


def module(path, index):
    return f"blocks.{index[0]}.{path}"


X = jax.random.normal(jax.random.key(9), (4, 24))


def test_outputs_match_peft():
    arrays = dict(np.load(GOLDEN / "adapter_lora_io.npz"))
    model = hugging_face.load_peft(FOLDER, reference_net(arrays))
    np.testing.assert_allclose(model(arrays["x"]), arrays["y"], rtol=0, atol=1e-5)
    expected = LoRA(rank=4, alpha=8)
    assert adaptation.methods(model) == {"lin/0": expected, "lin/2": expected}


@pytest.mark.parametrize("name", ["dora", "rs", "ada"])
def test_outputs_of_trained_folders_match_peft(name):
    """DoRA, rsLoRA and AdaLoRA, trained 20 SGD steps in PEFT 0.21.2; ranks and α by pattern."""
    arrays = dict(np.load(GOLDEN / "adapter_trained_io.npz"))
    model = hugging_face.load_peft(GOLDEN / f"adapter_{name}", reference_net(arrays))
    np.testing.assert_allclose(model(arrays["x"]), arrays[f"y/{name}"], rtol=0, atol=1e-5)


def test_saving_a_loaded_folder(tmp_path):
    hugging_face.save_peft(tmp_path, hugging_face.load_peft(FOLDER, Net()))
    ours, theirs = (
        safetensors.numpy.load_file(folder / hugging_face.TENSORS) for folder in (tmp_path, FOLDER)
    )
    assert ours.keys() == theirs.keys()
    for name, value in theirs.items():
        np.testing.assert_array_equal(ours[name], value)
    ours, theirs = (
        json.loads((folder / hugging_face.CONFIG).read_text()) for folder in (tmp_path, FOLDER)
    )
    for name, value in ours.items():
        assert theirs[name] == value, name


@pytest.mark.parametrize(
    "methods",
    [
        [LoRA(rank=3, alpha=4.0)],
        [LoRA(rank=3, rank_stabilized=True), LoRA(rank=5, alpha=1.0), LoRA(rank=3)],
        [DoRA(rank=3, alpha=4.0), DoRA(rank=2)],
        [AdaLoRA(rank=4, target_rank=2, alpha=4.0), LoRA(rank=2)],
    ],
    ids=["lora", "patterns", "dora", "adalora"],
)
def test_round_trip(methods, tmp_path):
    model = adapted(*((f"lin/{i}", method) for i, method in enumerate(methods)))
    if isinstance(methods[0], AdaLoRA):
        params = model.lin[0].adapter.get_value()
        model.lin[0].adapter.set_value(params | {"lora_e": params["lora_e"].at[1:].set(0.0)})
    hugging_face.save_peft(tmp_path, model)
    again = hugging_face.load_peft(tmp_path, Net())
    np.testing.assert_allclose(again(X), model(X), rtol=1e-5, atol=1e-5)
    ranks = [again.lin[i].method.rank for i in range(len(methods))]
    assert ranks == [1 if isinstance(m, AdaLoRA) else m.rank for m in methods]
    assert np.abs(again(X) - Net()(X)).max() > 0.1


def test_patterns_match_name_suffixes(copy):
    edit_config(copy, alpha_pattern={r".*(lin|mlp)\.[2-9]": 16}, rank_pattern={"2": 4})
    model = hugging_face.load_peft(copy, Net())
    assert [model.lin[i].method.scale for i in (0, 2)] == [2, 4]


def test_names_that_are_suffixes_of_others(tmp_path):
    class Twins(nnx.Module):
        def __init__(self):
            self.proj = nnx.Linear(4, 3, rngs=nnx.Rngs(0))
            self.head = nnx.List([nnx.Linear(3, 3, rngs=nnx.Rngs(1))])
            self.head[0].proj = nnx.Linear(4, 3, rngs=nnx.Rngs(2))

    rules = [("^proj", LoRA(rank=2, alpha=4.0)), ("head/0/proj", LoRA(rank=3, alpha=30.0))]
    model = trained(adaptation.adapt(Twins(), rules, rngs=nnx.Rngs(0)))
    hugging_face.save_peft(tmp_path, model)
    again = adaptation.merge(hugging_face.load_peft(tmp_path, Twins()))
    for ours, theirs in zip(
        jax.tree.leaves(nnx.state(again)),
        jax.tree.leaves(nnx.state(adaptation.merge(model))),
        strict=True,
    ):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


def test_stacks(tmp_path):
    method = LoRA(rank=2, alpha=3.0)
    model = trained(adaptation.adapt(Stack(), [("layer", method)], rngs=nnx.Rngs(0)))
    hugging_face.save_peft(tmp_path, model, names=module, base="a base")
    assert json.loads((tmp_path / hugging_face.CONFIG).read_text())["target_modules"] == [
        f"blocks.{i}.layer" for i in range(3)
    ]

    def shrink(tensors):  # reduce the second layer's rank
        for side, cut in (("A", np.s_[:1]), ("B", np.s_[:, :1])):
            name = f"base_model.model.blocks.1.layer.lora_{side}.weight"
            tensors[name] = np.ascontiguousarray(tensors[name][cut])
        return tensors

    edit_tensors(tmp_path, shrink)
    edit_config(tmp_path, alpha_pattern={"1.layer": 6.0}, rank_pattern={"1.layer": 1})
    again = hugging_face.load_peft(tmp_path, Stack(), names=module)
    ours, theirs = (adaptation.merge(m).layer.kernel.get_value() for m in (again, model))
    np.testing.assert_allclose(ours[::2], theirs[::2], atol=1e-5)
    params = {k: v[1] for k, v in model.layer.adapter.get_value().items()}
    one = 6.0 * params["lora_a"][:, :1] @ params["lora_b"][:1]
    np.testing.assert_allclose(ours[1], Stack().layer.kernel.get_value()[1] + one, atol=1e-5)

    with pytest.raises(ValueError, match="layer is a stack"):
        hugging_face.load_peft(tmp_path, Stack())
    edit_tensors(tmp_path, lambda t: {k: v for k, v in t.items() if "blocks.2" not in k})
    some = hugging_face.load_peft(tmp_path, Stack(), names=module)
    assert some.layer.method == LoRA(rank=2, alpha=3.0, ranks=(2, 1, 0))
    kernel = adaptation.merge(some).layer.kernel.get_value()
    np.testing.assert_array_equal(kernel[2], Stack().layer.kernel.get_value()[2])
    np.testing.assert_array_equal(kernel[:2], ours[:2])


@pytest.mark.parametrize("kind", [LoRA, DoRA])
def test_ranks_by_layer(kind, tmp_path):
    """A layer of rank 0 has no module in PEFT, unless it has a magnitude."""
    least = int(kind is DoRA)
    method = kind(rank=3, alpha=6.0, ranks=(3, least, 1))
    model = adaptation.adapt(Stack(), [("layer", method)], rngs=nnx.Rngs(0))
    values = dict(model.layer.adapter.get_value())
    values["lora_b"] = method.trimmed(values | {"lora_b": values["lora_b"] + 0.5})["lora_b"]
    model.layer.adapter.set_value(values)
    hugging_face.save_peft(tmp_path, model, names=module)
    config = json.loads((tmp_path / hugging_face.CONFIG).read_text())
    ranks = {n: r for n, r in enumerate(method.ranks) if r}
    assert config["target_modules"] == [f"blocks.{n}.layer" for n in ranks]
    of = lambda n, r: config[f"{r}_pattern"].get(f"^blocks\\.{n}\\.layer")  # noqa: E731
    assert {n: of(n, "rank") or config["r"] for n in ranks} == ranks
    assert {n: of(n, "alpha") or config["lora_alpha"] for n in ranks} == {
        n: 2.0 * r for n, r in ranks.items()
    }
    stored = safetensors.numpy.load_file(tmp_path / hugging_face.TENSORS)
    assert sum(x.size for x in stored.values()) == adaptation.count(model).trainable
    again = hugging_face.load_peft(tmp_path, Stack(), names=module)
    assert again.layer.method == method
    for name, value in again.layer.adapter.get_value().items():
        np.testing.assert_array_equal(value, values[name], err_msg=name)


def test_dora_on_some_layers_of_a_stack(tmp_path):
    model = adaptation.adapt(Stack(), [("layer", DoRA(rank=2))], rngs=nnx.Rngs(0))
    hugging_face.save_peft(tmp_path, model, names=module)
    edit_tensors(tmp_path, lambda t: {k: v for k, v in t.items() if "blocks.2" not in k})
    with pytest.raises(ValueError, match="only some layers of the stack layer with DoRA"):
        hugging_face.load_peft(tmp_path, Stack(), names=module)


class Attention(nnx.Module):
    """Flax's attention, whose kernels have head axes, and a layer of a user-defined class."""

    def __init__(self):
        self.attn = nnx.MultiHeadAttention(2, 6, decode=False, rngs=nnx.Rngs(0))
        self.own = Own()

    def __call__(self, x):
        return self.own(self.attn(x))


class Own(nnx.Module):
    """A user-defined einsum."""

    def __init__(self):
        self.w = nnx.Param(jax.random.normal(jax.random.key(3), (6, 4)))

    def __call__(self, x):
        return jnp.einsum("...i,io->...o", x, self.w[...])


def torch_names(path, index):
    return "model." + {"attn/query": "q_proj", "attn/out": "out_proj", "own": "head"}.get(
        path, path
    )


def attention_folder(folder):
    """Write a folder as PEFT does, from weights [out, in]; return updates [in, out] by module."""
    rng, tensors, updates = np.random.default_rng(0), {}, {}
    for name, d_out in (("q_proj", 6), ("out_proj", 6), ("head", 4)):
        a, b = (rng.normal(size=s).astype(np.float32) for s in ((2, 6), (d_out, 2)))
        tensors |= {
            f"base_model.model.model.{name}.lora_{k}.weight": v for k, v in (("A", a), ("B", b))
        }
        updates[name] = 2 * (b @ a).T
    safetensors.numpy.save_file(tensors, folder / hugging_face.TENSORS)
    config = {"peft_type": "LORA", "lora_alpha": 4, "r": 2}
    (folder / hugging_face.CONFIG).write_text(json.dumps(config))
    return updates


def test_attention_with_head_axes_and_user_defined_einsums(tmp_path):
    """Kernels [D, N, H] and [N, H, D] match torch's with concatenated heads."""
    updates, base = attention_folder(tmp_path), Attention()
    einsums = {Own: lambda layer: ("w", "...i,io->...o")}
    model = hugging_face.load_peft(tmp_path, base, names=torch_names, einsums=einsums)
    merged = adaptation.merge(model)
    changes = {
        "q_proj": (merged.attn.query.kernel, base.attn.query.kernel),
        "out_proj": (merged.attn.out.kernel, base.attn.out.kernel),
        "head": (merged.own.w, base.own.w),
    }
    for name, (after, before) in changes.items():
        change = (after[...] - before[...]).reshape(updates[name].shape)
        np.testing.assert_allclose(change, updates[name], atol=1e-5)
    hugging_face.save_peft(tmp_path / "again", model, names=torch_names)
    ours, theirs = (
        safetensors.numpy.load_file(folder / hugging_face.TENSORS)
        for folder in (tmp_path / "again", tmp_path)
    )
    assert ours.keys() == theirs.keys()
    for name, value in theirs.items():
        np.testing.assert_array_equal(ours[name], value)
    with pytest.raises(ValueError, match=r"'model.head', .* model\."):
        hugging_face.load_peft(tmp_path, base, names=torch_names)


def test_adapters_on_other_layers_are_kept():
    fresh = hugging_face.load_peft(FOLDER, Net())
    (other,) = {"lin/0", "lin/1", "lin/2"} - adaptation.methods(fresh).keys()
    model = adaptation.adapt(Net(), [(other, LoRA(rank=3))], rngs=nnx.Rngs(1))
    loaded = hugging_face.load_peft(FOLDER, model)
    expected = adaptation.methods(model) | adaptation.methods(fresh)
    assert adaptation.methods(loaded) == expected
