"""Properties of every backbone, without recorded values: masks, adapters, remat, dtypes."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.models import pi0, smolvla
from lorasp_jax.peft import LoRA, LoRASP
from lorasp_jax.training.cost.preflight import REMATS
from tests.models.random_models import observation, random_backbone

BATCH, RANK, STEPS = 2, 4, 2
MLP = "gate_proj up_proj down_proj"
VISION = "patch_embed q_proj k_proj v_proj out_proj fc1 fc2 head"
PROJECTIONS = "state_proj action_in_proj action_time_mlp_in action_time_mlp_out action_out_proj"
EXPERT = f"q_proj k_proj v_proj o_proj {MLP}"
PAIR = [f"{layer}/{name}" for layer in ("self_layer", "cross_layer") for name in EXPERT.split()]
ACTION = {pi0: EXPERT.split(), smolvla: PAIR}


@pytest.fixture(scope="module", params=[pi0, smolvla], ids=["pi0", "smolvla"])
def backbone(request):
    return request.param


@pytest.fixture(scope="module")
def config(backbone):
    return backbone.Config.dummy()


@pytest.fixture(scope="module")
def model(config):
    return random_backbone(config)


@pytest.fixture(scope="module")
def obs(config):
    return observation(config, BATCH)


@pytest.fixture(scope="module")
def actions(config):
    shape = (BATCH, config.chunk, config.action_dim)
    return jax.device_put(np.random.default_rng(1).normal(size=shape).astype("f"))


@pytest.fixture(scope="module")
def velocity(model):
    """(obs, x_t) -> v_t at time 0.4, compiled once."""
    return jax.jit(lambda obs, x_t: model.velocity(obs, x_t, jnp.full(BATCH, 0.4)))


def test_missing_camera_and_wrong_size_raise(model, obs):
    with pytest.raises(ValueError, match=r"'side', 'wrist'.* \(32, 32, 3\)"):
        model.embed_prefix(dataclasses.replace(obs, images={"side": obs.images["side"]}))
    large = {name: jnp.zeros((BATCH, 64, 64, 3)) for name in obs.images}
    with pytest.raises(ValueError, match=r"got \{'side': \(64, 64, 3\)"):
        model.embed_prefix(dataclasses.replace(obs, images=large))


def test_padding_and_missing_cameras_do_not_affect_the_velocity(velocity, obs, actions):
    expected = velocity(obs, actions)
    wrist = obs.images["wrist"].at[1].set(0.7)
    tokens = jnp.where(obs.token_mask, obs.tokens, 9)
    masked_change = dataclasses.replace(obs, images={**obs.images, "wrist": wrist}, tokens=tokens)
    np.testing.assert_array_equal(velocity(masked_change, actions), expected)
    valid_change = dataclasses.replace(obs, images={**obs.images, "wrist": wrist.at[0].set(0.7)})
    assert np.abs(velocity(valid_change, actions) - expected)[0].max() > 1e-4


def test_every_action_depends_on_the_state(velocity, obs, actions):
    other = velocity(dataclasses.replace(obs, state=obs.state + 1), actions)
    assert (np.abs(other - velocity(obs, actions)).max(axis=-1) > 1e-6).all()


@pytest.fixture(scope="module")
def adapted(model):
    """LoRA-SP in some layers of every tower; LoRA, which compiles faster, elsewhere."""
    # The gate has its own tests; without its search (η = 1) this compiles in a third of the time.
    sparse = LoRASP(rank=RANK, hidden_width=4, energy_target=1.0)
    rules = [
        ("vision/head|language/.*o_proj|state_proj|cross_layer/k_proj", sparse),
        (".*", LoRA(rank=2)),
    ]
    return lorasp_jax.adapt(model, rules, rngs=nnx.Rngs(1))


@pytest.fixture(scope="module")
def mask(actions):
    """A padded last step, two unused slots."""
    mask = np.ones(actions.shape, bool)
    mask[:, -1] = mask[:, :, 5:7] = False
    return mask


@pytest.fixture(scope="module")
def loss_of(config, obs, actions, mask):
    """Runtime fields -> the mean loss and the loss per element as a function of the parameters."""

    def make(**change):
        build = lambda: dataclasses.replace(config, **change).create(nnx.Rngs(0))  # noqa: E731
        graphdef = nnx.split(nnx.eval_shape(build))[0]

        def loss(parameters):
            model = nnx.merge(graphdef, parameters)
            per_element = model.loss(jax.random.key(2), obs, actions, action_mask=mask)[0]
            return jnp.mean(per_element, where=mask), per_element

        return loss

    return make


@pytest.fixture(scope="module")
def traced(model, loss_of):
    """Remat -> a program that returns loss, gradients and residuals."""
    parameters = nnx.split(model)[1]

    @functools.cache
    def trace(remat):
        def run(parameters):
            loss, vjp, per_element = jax.vjp(loss_of(remat=remat), parameters, has_aux=True)
            return (loss, per_element), vjp(1.0), vjp

        return jax.jit(run).trace(parameters)

    return trace


@pytest.fixture(scope="module")
def run(model, traced):
    """Remat -> (loss, loss per element), gradients."""
    parameters = nnx.split(model)[1]
    return functools.cache(lambda remat: traced(remat).lower().compile()(parameters)[:2])


@pytest.fixture(scope="module")
def trained(adapted, obs, actions, mask):
    """Loss, aux and gradients."""
    graphdef, adapters, frozen = lorasp_jax.split(adapted)

    def loss(adapters):
        model = nnx.merge(graphdef, adapters, frozen)
        per_element, aux = model.loss(jax.random.key(2), obs, actions, action_mask=mask)
        return jnp.mean(per_element, where=mask), (per_element, aux)

    values = jax.jit(jax.value_and_grad(loss, has_aux=True))(adapters)
    (_, (per_element, aux)), grads = jax.device_get(values)
    return per_element, aux, nnx.to_pure_dict(grads)


def test_every_dense_layer_has_aux(trained, backbone, actions):
    per_element, aux, _ = trained
    assert per_element.shape == actions.shape
    assert per_element.dtype == jnp.float32
    assert {tower: set(layers) for tower, layers in aux.items()} == {
        "vision": set(VISION.split()),
        "language": set(EXPERT.split()),
        "action": {*ACTION[backbone], *PROJECTIONS.split()},
    }


def test_adapters_initially_do_not_change_the_loss(trained, run):
    np.testing.assert_allclose(trained[0], run("none")[0][1], rtol=1e-4, atol=1e-5)


def test_aux_is_masked(trained, config, obs):
    _, aux, _ = trained
    patches = config.patches
    prefix = 3 * config.image_tokens + 3 + 5  # three of four images, the valid language tokens
    counts = {
        tower: {name: int(a.token_mask.sum(axis=(-2, -1)).max()) for name, a in layers.items()}
        for tower, layers in aux.items()
    }
    assert counts["vision"] == {
        name: 3 * (config.image_tokens if name == "head" else patches) for name in counts["vision"]
    }
    state = BATCH if isinstance(config, smolvla.SmolVLAConfig) else 0
    assert set(counts["language"].values()) == {prefix + state}
    valid = BATCH * (config.chunk - 1)
    assert counts["action"]["action_out_proj"] == counts["action"]["action_in_proj"] == valid
    assert counts["action"]["state_proj"] == BATCH
    cross = {n: c for n, c in counts["action"].items() if n.startswith("cross_layer/")}
    assert all(c == (prefix + state if n[-6] in "kv" else valid) for n, c in cross.items())
    assert aux["vision"]["head"].losses["balance"].shape == ()
    assert aux["language"]["o_proj"].losses["spectral"].shape == (config.language.depth,)


def test_adapters_have_gradients(trained, backbone):
    """U and B are initialized to zero, so initially only they have a gradient, in every layer."""
    _, _, grads = trained
    ups = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(grads):
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        ups.append(name.endswith(("bank/u", "lora_b")))
        assert bool(np.any(leaf)) == ups[-1], name
    assert sum(ups) == 8 + 7 + len(ACTION[backbone]) + 5


def test_unused_slots_do_not_affect_the_sample(model, config, obs, actions):
    """x_t is zero there, in sampling as in training."""
    rules = [("state_proj|action_out_proj|^action/.*o_proj", LoRA(rank=2))]
    adapted = lorasp_jax.adapt(model, rules, rngs=nnx.Rngs(1))
    slots = np.arange(config.action_dim) < 5

    @jax.jit
    def sample(noise: jax.Array):
        options = {"noise": noise, "slots": slots, "num_steps": STEPS}
        return adapted.sample_actions(jax.random.key(0), obs, **options, return_aux=True)

    sampled, aux = sample(actions)
    other, _ = sample(jnp.where(slots, actions, 7.0))
    np.testing.assert_array_equal(sampled, other)
    assert not np.any(sampled[..., 5:])
    ranks = [layer.active_rank for layer in aux["action"].values() if layer.active_rank is not None]
    assert {rank.shape[0] for rank in ranks} == {STEPS}
    # SmolVLA projects the state once per observation, so its aux is the same in all steps.
    state_rank = aux["action"]["state_proj"].active_rank
    np.testing.assert_array_equal(state_rank[0], state_rank[-1])


def test_remat_does_not_change_gradients(backbone, run):
    """Each policy with one of the backbones, which scan their layers in the same way."""
    close = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5)
    for remat in {pi0: ("narrow", "full"), smolvla: ("products",)}[backbone]:
        jax.tree.map(close, run(remat), run("none"))


def test_remat_saves_fewer_residuals(traced):
    def residual_size(remat):
        return sum(a.size for a in jax.tree.leaves(traced(remat).out_info[2]))

    none, products, narrow, full = map(residual_size, REMATS)
    assert none > 1.5 * products > 1.5 * full
    assert products >= narrow > full  # equal, since no layer of these is wide


def test_unroll_and_bfloat16_hardly_change_the_loss(model, loss_of, run):
    parameters, loss = nnx.split(model)[1], run("none")[0][0]
    np.testing.assert_allclose(jax.jit(loss_of(unroll=True))(parameters)[0], loss, rtol=1e-5)
    half = jax.jit(loss_of(dtype="bfloat16"))(parameters)[0]
    assert half != loss
    np.testing.assert_allclose(half, loss, rtol=0.02)


def test_works_without_graph_mode(config, obs, actions):
    """The future default of NNX: trees only."""
    with nnx.set_graph_mode(False), nnx.set_graph_updates(False):
        graphdef, state = nnx.split(nnx.eval_shape(lambda: config.create(nnx.Rngs(0))))
        sampled = jax.eval_shape(
            lambda state: nnx.merge(graphdef, state).sample_actions(jax.random.key(0), obs), state
        )
    assert sampled.shape == actions.shape
