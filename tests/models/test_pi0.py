"""Laws of pi0 that need no recorded numbers: sizes, who sees whom, adapters, remat, types."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.models.layers import block_mask
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import LoRASP

CONFIG = Pi0Config.dummy()
BATCH, RANK = 2, 4
TOWERS = {
    "vision": "patch_embed q_proj k_proj v_proj out_proj fc1 fc2 head",
    "language": "q_proj k_proj v_proj o_proj gate_proj up_proj down_proj",
    "action": "q_proj k_proj v_proj o_proj gate_proj up_proj down_proj state_proj action_in_proj "
    "action_time_mlp_in action_time_mlp_out action_out_proj",
}


def size(model: nnx.Module) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(nnx.state(model, nnx.Param)))


def actions(seed: int = 1) -> jax.Array:
    return jax.random.normal(jax.random.key(seed), (BATCH, CONFIG.chunk, CONFIG.action_dim))


@pytest.fixture(scope="module")
def obs():
    keys = jax.random.split(jax.random.key(0), 3)
    shape = (BATCH, CONFIG.image_size, CONFIG.image_size, 3)
    return Observation(
        images={n: jax.random.uniform(keys[0], shape, minval=-1) for n in CONFIG.cameras},
        image_masks={"side": jnp.ones(BATCH, bool), "wrist": jnp.array([True, False])},
        tokens=jax.random.randint(keys[1], (BATCH, CONFIG.max_tokens), 0, CONFIG.vocabulary),
        token_mask=jnp.arange(CONFIG.max_tokens) < jnp.array([[3], [5]]),
        state=jax.random.normal(keys[2], (BATCH, CONFIG.action_dim)),
    )


@pytest.fixture(scope="module")
def model():
    return CONFIG.create(nnx.Rngs(0))


@pytest.fixture(scope="module")
def velocity(model, obs):
    """Compiled once: (obs, x_t) -> v_t at time 0.4."""
    time = jnp.full(BATCH, 0.4)
    return jax.jit(lambda obs, x_t: model.velocity(obs, x_t, time))


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("base", 3_238_048_528, 3_238_048_528), ("small", 8e6, 10e6), ("nano", 0.9e6, 1.2e6)],
)
def test_parameter_counts(name, low, high):
    config = getattr(Pi0Config, name)()
    assert low <= size(nnx.eval_shape(lambda: config.create(nnx.Rngs(0)))) <= high


def test_base_towers():
    """SigLIP with its head, both experts, the projections (openpi, shape evaluation)."""
    model = nnx.eval_shape(lambda: Pi0Config.base().create(nnx.Rngs(0)))
    assert size(model.vision) == 414_803_696
    assert size(model.language) + size(model.action) == 2_819_996_672
    assert size(model.action) == 311_464_960


def test_config_says_what_is_wrong():
    with pytest.raises(ValueError, match="experts share attention, but depth is 2 and 3"):
        dataclasses.replace(CONFIG, action=dataclasses.replace(CONFIG.action, depth=3))
    with pytest.raises(ValueError, match="not a multiple of the patch, 16"):
        dataclasses.replace(CONFIG, image_size=40)


def test_missing_camera_and_wrong_size_raise(model, obs):
    with pytest.raises(ValueError, match=r"need pictures \(32, 32, 3\) of \('side', 'wrist'\)"):
        model.embed_prefix(dataclasses.replace(obs, images={"side": obs.images["side"]}))
    large = {name: jnp.zeros((BATCH, 64, 64, 3)) for name in CONFIG.cameras}
    with pytest.raises(ValueError, match=r"got \{'side': \(64, 64, 3\)"):
        model.embed_prefix(dataclasses.replace(obs, images=large))


def test_padding_and_missing_cameras_are_not_seen(velocity, obs):
    x_t = actions()
    wanted = velocity(obs, x_t)
    wrist = obs.images["wrist"].at[1].set(0.7)
    tokens = jnp.where(obs.token_mask, obs.tokens, 9)
    hidden = dataclasses.replace(obs, images={**obs.images, "wrist": wrist}, tokens=tokens)
    np.testing.assert_array_equal(velocity(hidden, x_t), wanted)
    seen = dataclasses.replace(obs, images={**obs.images, "wrist": wrist.at[0].set(0.7)})
    assert np.abs(velocity(seen, x_t) - wanted)[0].max() > 1e-4


def test_every_action_sees_every_action_and_the_state(velocity, obs):
    x_t = actions()
    wanted = velocity(obs, x_t)
    last = np.abs(velocity(obs, x_t.at[:, -1].add(1.0)) - wanted)
    assert (last.max(axis=-1) > 1e-6).all()
    other = velocity(dataclasses.replace(obs, state=obs.state + 1), x_t)
    assert (np.abs(other - wanted).max(axis=-1) > 1e-6).all()


def test_state_does_not_see_actions(model, obs):
    """The state's keys and values, and with them its whole row, are the same for any x_t."""

    def state_row(x_t: jax.Array) -> jax.Array:
        prefix, _ = model.run_prefix(obs)
        tokens, _ = model.embed_suffix(obs, x_t, jnp.full(BATCH, 0.4))
        block = np.array([1] + [2] * CONFIG.chunk)
        seen = np.concatenate([np.zeros(prefix.valid.shape[1], int), block])
        valid = jnp.ones(tokens.shape[:2], bool)
        key_valid = jnp.concatenate([prefix.valid, valid], axis=1)
        mask = block_mask(block, seen, valid, key_valid)
        position = jnp.broadcast_to(jnp.arange(tokens.shape[1]), tokens.shape[:2])
        return model.action(tokens, position, mask, prefix.cache, token_mask=valid)[0][:, 0]

    row = jax.jit(state_row)
    np.testing.assert_array_equal(row(actions(1)), row(actions(2)))


@pytest.fixture(scope="module")
def adapted(model):
    # The gate has its own tests; without a search (η = 1) this compiles in a third of the time.
    methods = [(".*", LoRASP(rank=RANK, hidden_width=4, energy_target=1.0))]
    return lorasp_jax.adapt(model, methods, rngs=nnx.Rngs(1))


@pytest.fixture(scope="module")
def trained(adapted, obs):
    """Loss, aux and gradients with a padded last step, two unused slots."""
    mask = jnp.ones((BATCH, CONFIG.chunk, CONFIG.action_dim), bool)
    mask = mask.at[:, -1].set(False).at[:, :, 5:7].set(False)
    graphdef, adapters, frozen = lorasp_jax.adaptation.split(adapted)

    def loss(adapters):
        model = nnx.merge(graphdef, adapters, frozen)
        per_element, aux = model.loss(jax.random.key(2), obs, actions(), action_mask=mask)
        return jnp.mean(per_element, where=mask), (per_element, aux)

    (_, (per_element, aux)), grads = jax.jit(jax.value_and_grad(loss, has_aux=True))(adapters)
    return per_element, aux, nnx.to_pure_dict(grads)


def test_every_dense_layer_is_reached(trained):
    per_element, aux, _ = trained
    assert per_element.shape == (BATCH, CONFIG.chunk, CONFIG.action_dim)
    assert per_element.dtype == jnp.float32
    assert {tower: set(layers) for tower, layers in aux.items()} == {
        tower: set(names.split()) for tower, names in TOWERS.items()
    }


def test_reports_are_stacked_and_masked(trained, obs):
    _, aux, _ = trained
    depth, image = CONFIG.language.depth, CONFIG.image_tokens
    prefix = len(CONFIG.cameras) * image + CONFIG.max_tokens
    cameras = BATCH * len(CONFIG.cameras)
    shapes = {tower: aux[tower]["q_proj"].active_rank.shape for tower in aux}
    assert shapes == {
        "vision": (CONFIG.vision.depth, cameras, image),
        "language": (depth, BATCH, prefix),
        "action": (depth, BATCH, 1 + CONFIG.chunk),
    }
    assert aux["vision"]["head"].losses["balance"].shape == ()
    assert aux["language"]["o_proj"].losses["spectral"].shape == (depth,)
    counted = {tower: int(aux[tower]["q_proj"].token_mask[0].sum()) for tower in aux}
    assert counted == {
        "vision": 3 * image,
        "language": 3 * image + 3 + 5,
        "action": BATCH * CONFIG.chunk,
    }


def test_adapters_train(trained):
    """U starts at zero, so at first U alone has a gradient, in every layer."""
    _, _, grads = trained
    leaves = jax.tree_util.tree_leaves_with_path(grads)
    for path, leaf in leaves:
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        assert bool(np.any(leaf)) == name.endswith("bank/u"), name
    assert sum("bank" in str(path) and "'u'" in str(path) for path, _ in leaves) == 27


def test_unused_slots_do_not_matter(adapted, obs):
    """x_t is held at zero there, in training and in sampling."""
    slots = np.arange(CONFIG.action_dim) < 5

    @jax.jit
    def sample(noise: jax.Array):
        fixed = {"noise": noise, "slots": slots, "num_steps": 3}
        return adapted.sample_actions(jax.random.key(0), obs, **fixed, return_aux=True)

    found, aux = sample(actions())
    other, _ = sample(jnp.where(slots, actions(), 7.0))
    np.testing.assert_array_equal(found, other)
    assert not np.any(found[..., 5:])
    assert aux["action"]["q_proj"].active_rank.shape[:2] == (3, CONFIG.action.depth)


def loss_of(obs, **change):
    """The dummy's mean loss as a function of its parameters, under other runtime fields."""
    config = dataclasses.replace(CONFIG, **change)
    graphdef = nnx.split(nnx.eval_shape(lambda: config.create(nnx.Rngs(0))))[0]

    def loss(parameters):
        return nnx.merge(graphdef, parameters).loss(jax.random.key(2), obs, actions())[0].mean()

    return loss


def test_remat_changes_nothing(model, obs):
    parameters = nnx.split(model)[1]
    plain, remat = (
        jax.jit(jax.value_and_grad(loss_of(obs, remat=remat)))(parameters)
        for remat in (False, True)
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), remat, plain)


def test_unroll_and_bfloat16_hardly_change_the_loss(model, obs):
    parameters = nnx.split(model)[1]
    plain = jax.jit(loss_of(obs))(parameters)
    np.testing.assert_allclose(jax.jit(loss_of(obs, unroll=True))(parameters), plain, rtol=1e-5)
    half = jax.jit(loss_of(obs, dtype="bfloat16"))(parameters)
    assert half != plain
    np.testing.assert_allclose(half, plain, rtol=0.02)


def test_works_without_graph_mode(obs):
    """NNX as it will be: trees only."""
    with nnx.set_graph_mode(False), nnx.set_graph_updates(False):
        graphdef, state = nnx.split(nnx.eval_shape(lambda: CONFIG.create(nnx.Rngs(0))))
        found = jax.eval_shape(
            lambda state: nnx.merge(graphdef, state).sample_actions(jax.random.key(0), obs), state
        )
    assert found.shape == (BATCH, CONFIG.chunk, CONFIG.action_dim)
