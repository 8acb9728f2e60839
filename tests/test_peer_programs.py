"""Test that the programs that are compared do the same work."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from benchmarks.peers import cases, openpi, ours, workloads
from lorasp_jax.adapters import adaptation
from tests.test_peers import job


def test_all_programs_get_the_same_numbers():
    one, two = (workloads.policy_batch(workloads.PI0["tiny"], 2) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, one, two)
    batch = ours.batch(job("pi0-sample"), 2)
    images = batch.observation.images
    np.testing.assert_array_equal(images["left_wrist_0_rgb"], one["images"][1])
    np.testing.assert_array_equal(batch.actions, one["actions"])
    assert len(images) == workloads.PI0["tiny"].cameras
    assert np.abs(one["images"][0]).max() <= 1


@pytest.mark.parametrize("table", ["pi0-train", "smolvla-train"])
def test_published_sizes_are_the_defaults(table):
    config = ours.model_config(job(table, size="base"))
    shape = ours.workload(job(table, size="base"))[1]
    published = type(config).base()
    assert (config.vision, config.language, config.action) == (
        published.vision,
        published.language,
        published.action,
    )
    assert (shape.batch, shape.chunk, shape.tokens) == (32, published.chunk, published.max_tokens)
    assert (shape.image, shape.dim) == (published.image_size, published.action_dim)


TRAINED = {
    # All that openpi trains but its LoRA (models/pi0_config.py), and LoRA without pairs per head.
    ("pi0-train", ours.OPENPI): 468_039_440 - 49_987_584 + 1_225_728 * 16 + 433_152 * 32,
    # What LeRobot trains by default.
    ("smolvla-expert", "expert only"): 99_880_992,
}


@pytest.mark.parametrize(("case", "expected"), TRAINED.items(), ids=str)
def test_the_same_parameters_are_trained_as_elsewhere(case, expected):
    chosen = job(*case, size="base")
    config = ours.model_config(chosen)

    def model():
        return adaptation.adapt(config.create(nnx.Rngs(0)), ours.rules(chosen)[0], rngs=nnx.Rngs(1))

    trained = adaptation.split(nnx.eval_shape(model))[1]
    assert sum(leaf.size for leaf in jax.tree.leaves(trained)) == expected


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [(t, v) for t, entries in cases.TABLES.items() for p, v in entries if p == cases.OURS],
    ids="-".join,
)
def test_every_variant_of_ours_runs(case):
    rows = list(ours.measure(job(*case)))
    assert rows
    assert all(row["median_s"] > 0 for row in rows)


@pytest.mark.parametrize("size", ["base", "tiny"])
def test_smolvla_has_the_same_sizes_elsewhere(size):
    config = ours.model_config(job("smolvla-train", size=size))
    towers = workloads.SMOLVLA_TOWERS[size]
    language, vision = config.language, config.vision
    assert towers["text"] == {
        "hidden_size": language.width,
        "intermediate_size": language.mlp,
        "num_hidden_layers": language.depth,
        "num_attention_heads": language.heads,
        "num_key_value_heads": language.kv_heads,
        "head_dim": language.head_dim,
        "vocab_size": config.vocabulary,
    }
    assert towers["vision"] == {
        "hidden_size": vision.width,
        "intermediate_size": vision.mlp,
        "num_hidden_layers": vision.depth,
        "num_attention_heads": vision.heads,
        "patch_size": vision.patch,
    }
    assert towers["model"] == {"scale_factor": vision.shuffle}
    # LeRobot derives the expert: 3/4 of the width, and a multiple of 256 for its MLP.
    width = int(0.75 * language.width)
    assert config.action.width == width
    assert config.action.mlp == 256 * -(-int(4 * int(2 * width / 3)) // 256)


def test_pi0_has_the_same_tiny_sizes_elsewhere():
    config = ours.model_config(job("pi0-train"))
    for expert in (config.language, config.action):
        assert {
            "width": expert.width,
            "depth": expert.depth,
            "mlp_dim": expert.mlp,
            "num_heads": expert.heads,
            "num_kv_heads": expert.kv_heads,
            "head_dim": expert.head_dim,
        } == openpi.TINY


AUGMENTED: list[bool] = []


class Model(nnx.Module):
    """What the worker needs of openpi's model: a loss, sampling, trained and frozen layers."""

    def __init__(self, key):
        rngs = nnx.Rngs(key)
        self.lora, self.frozen = nnx.Linear(8, 8, rngs=rngs), nnx.Linear(8, 8, rngs=rngs)

    def compute_loss(self, key, observation, actions, *, train):
        del key
        AUGMENTED.append(train)
        predicted = self.frozen(self.lora(observation.state))[:, None]
        return jnp.square(predicted - actions).mean(-1) + train

    def sample_actions(self, key, observation, *, num_steps):
        return self.frozen(self.lora(observation.state)) + num_steps


@pytest.fixture
def stand_in(monkeypatch):
    """Put a small model in openpi's place; return what its optimizer saw."""
    seen = {}

    class Config:
        def __init__(self, **options):
            seen["config"] = options

        create = staticmethod(Model)

        def get_freeze_filter(self):
            return lambda path, _: "frozen" in path

    def optimizer(config, schedule):
        del config, schedule
        update = optax.sgd(0.1)

        def init(params):
            seen["trained"] = jax.tree.map(lambda x: x.dtype, params)
            return update.init(params)

        return optax.GradientTransformation(init, update.update)

    modules = types.SimpleNamespace(
        pi0_config=types.SimpleNamespace(Pi0Config=Config),
        model=types.SimpleNamespace(Observation=Observation),
        optimizer=types.SimpleNamespace(
            AdamW=object, CosineDecaySchedule=object, create_optimizer=optimizer
        ),
        nnx_utils=types.SimpleNamespace(module_jit=lambda method: method),
    )
    monkeypatch.setattr(openpi, "import_models", lambda: modules)
    monkeypatch.setattr(openpi, "shrink", lambda image: seen.update(image=image))
    return seen


@jax.tree_util.register_dataclass
@dataclasses.dataclass
class Observation:
    images: dict
    image_masks: dict
    state: jax.Array
    tokenized_prompt: jax.Array
    tokenized_prompt_mask: jax.Array


@pytest.mark.parametrize(
    ("variant", "augmented"), [("LoRA", True), ("LoRA without augmentation", False)]
)
def test_openpi_trains_only_what_it_does_not_freeze(variant, augmented, stand_in):
    AUGMENTED.clear()
    (row,) = openpi.measure(job("pi0-train", variant))
    assert (row["item"], row["samples"], row["trainable"]) == ("batch 2", 2, 72)
    assert stand_in["config"]["paligemma_variant"] == "gemma_2b_lora"
    assert set(AUGMENTED) == {augmented}
    assert stand_in["image"] == workloads.PI0["tiny"].image
    assert {str(dtype) for dtype in jax.tree.leaves(stand_in["trained"])} == {"float32"}


def test_openpi_samples_with_all_weights_in_bf16(stand_in):
    _, rest, frozen = openpi.split(types.SimpleNamespace(create=Model), lambda *_: False)
    assert not jax.tree.leaves(rest)
    assert {x.dtype for x in jax.tree.leaves(frozen)} == {jnp.dtype("bfloat16")}
    rows = list(openpi.measure(job("pi0-sample")))
    items = [f"batch {b}, {n} denoising steps" for b in (1, 2) for n in (3, 10)]
    assert [row["item"] for row in rows] == items
    assert stand_in["config"]["action_expert_variant"] == "gemma_300m"
