"""Test LoRA-MoE losses against Hugging Face, routing against loops, and special cases."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.peft import LoRA, LoRASP
from lorasp_jax.peft.lora_moe import LoRAMoE, balance_loss, softmax, z_loss
from tests import GOLDEN

GOLDEN = GOLDEN / "moe_switch_losses.npz"
D_IN, D_OUT, EXPERTS, RANK = 6, 5, 4, 2
TOP1 = [
    LoRAMoE(EXPERTS, RANK, routing="top1"),
    LoRAMoE(EXPERTS, RANK, alpha=5.0, routing="top1", gate_gradient="switch"),
]
ALL = [LoRAMoE(EXPERTS, RANK, alpha=5.0), *TOP1]


delta_of = jax.jit(lambda method, params, x: method.delta(params, x), static_argnums=0)


def normal(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape).astype("f")


@pytest.fixture(scope="module")
def x():
    return normal(0, 3, 7, D_IN)


def arrays(experts=EXPERTS, rank=RANK):
    """Nonzero parameters, with a router whose probabilities differ clearly."""
    width = experts * rank
    shapes = {"lora_a": (D_IN, width), "lora_b": (width, D_OUT), "router": (D_IN, experts)}
    return {name: normal(1 + i, *shape) for i, (name, shape) in enumerate(shapes.items())}


def probabilities_of(x, router):
    """Softmax of x @ router in float64."""
    exponentials = np.exp(np.asarray(x, np.float64) @ np.asarray(router, np.float64))
    return exponentials / exponentials.sum(-1, keepdims=True)


def expert_deltas(params, x, rank=RANK):
    """x A_i B_i of each expert in float64, [E, tokens, O]."""
    x, a, b = (np.asarray(v, np.float64) for v in (x, params["lora_a"], params["lora_b"]))
    starts = range(0, a.shape[1], rank)
    return np.stack([x @ a[:, i : i + rank] @ b[i : i + rank] for i in starts])


def test_losses_equal_hugging_face():
    """Hugging Face averages the balance loss over sequences (1.0865); we pool tokens (1.0253)."""
    with np.load(GOLDEN) as file:
        logits, balance, z = (file[name] for name in ("logits", "lb", "z"))

    @jax.jit
    def losses(logits):
        each = jax.nn.softmax(logits)
        ours = [balance_loss(sequence, None) for sequence in each]
        return jnp.stack(ours).mean(), balance_loss(each, None), z_loss(logits, None)

    np.testing.assert_allclose(losses(logits), [balance, 1.025313, z], rtol=1e-5)


def test_balance_loss_range_and_gradient():
    """1 for evenly spread tokens, E if all use one expert; only P has a gradient, E f / n."""
    spread, single = np.eye(EXPERTS) * 0.9 + 0.1 / EXPERTS, np.eye(EXPERTS)[[0] * EXPERTS]
    loss = jax.jit(balance_loss)
    assert loss(spread, None) == pytest.approx(1)
    assert loss(single, None) == pytest.approx(EXPERTS)
    rows = jnp.array([[0.7, 0.3], [0.6, 0.4], [0.2, 0.8]])
    gradient = jax.jit(jax.grad(balance_loss))(rows, None)
    np.testing.assert_allclose(gradient, np.tile([2 * 2 / 9, 2 / 9], (3, 1)), rtol=1e-6)


def test_weighted_equals_a_loop_over_experts(x):
    method, params = ALL[0], arrays()
    weights = probabilities_of(x, params["router"])
    expected = 0
    for i, expert in enumerate(expert_deltas(params, x)):
        expected += 2.5 * weights[..., i, None] * expert
    delta, aux = delta_of(method, params, x)
    np.testing.assert_allclose(delta, expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(aux.active_rank, EXPERTS * RANK)


@pytest.mark.parametrize("method", TOP1, ids=lambda method: method.gate_gradient)
def test_top1_uses_one_expert(method, x):
    params, switch = arrays(), method.gate_gradient == "switch"
    weights = probabilities_of(x, params["router"])
    deltas = expert_deltas(params, x)
    expected = np.zeros((*x.shape[:-1], D_OUT))
    for token in np.ndindex(x.shape[:-1]):
        best = weights[token].argmax()
        expected[token] = deltas[(best, *token)] * (weights[token][best] if switch else 1)
    delta, aux = delta_of(method, params, x)
    np.testing.assert_allclose(delta, method.scale * expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(aux.active_rank, RANK)
    bottleneck = lambda params, x: method.bottleneck(params, x @ method.down(params), None)  # noqa: E731
    z, _ = jax.jit(bottleneck)(params, x)
    used = (np.asarray(z) != 0).reshape(*x.shape[:-1], EXPERTS, RANK)
    np.testing.assert_array_equal(used.all(-1), used.any(-1))
    np.testing.assert_array_equal(used.any(-1).sum(-1), 1)
    assert len(np.unique(weights.argmax(-1))) > 1


@pytest.mark.parametrize("method", ALL, ids=lambda m: f"{m.routing}-{m.gate_gradient}")
def test_router_gets_a_task_gradient_unless_top1_is_hard(method, x):
    def task(params):
        return jnp.sum(method.delta(params, x)[0] ** 2)

    def router_losses(params):
        return sum(method.delta(params, x)[1].losses.values())

    of_task, of_losses = (
        np.abs(gradient["router"])
        for gradient in jax.jit(lambda p: (jax.grad(task)(p), jax.grad(router_losses)(p)))(arrays())
    )
    assert of_losses.max() > 1e-3
    assert of_task.max() > 1e-3 if method is not TOP1[0] else of_task.max() == 0


@pytest.mark.parametrize("fields", [{}, {"routing": "top1"}, TOP1[1].__dict__ | {"alpha": None}])
def test_one_expert_equals_lora(fields, x):
    params = arrays(experts=1, rank=3)
    ours, aux = delta_of(LoRAMoE(**fields | {"experts": 1, "rank": 3}), params, x)
    lora = {"lora_a": params["lora_a"], "lora_b": params["lora_b"]}
    theirs, theirs_aux = delta_of(LoRA(rank=3), lora, x)
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(aux.active_rank, theirs_aux.active_rank)
    assert aux.losses["balance"] == pytest.approx(1)


@pytest.mark.parametrize("seed", range(3))
def test_initial_paper_lora_sp_equals_weighted_moe(seed, x):
    """They are equal for η = 1 and the initial 0/1 matrix W2, for any bank and W1."""
    sp = LoRASP.paper(rank=EXPERTS * RANK, energy_target=1.0)
    initial, _ = jax.jit(sp.init)(jax.random.key(seed), np.zeros((D_IN, D_OUT), "f"))
    bank = initial["bank"] | {"u": normal(seed, sp.rank, D_OUT)}
    w1 = np.asarray(initial["router"]["w1"]) * np.float32(3.0**seed)
    theirs, _ = delta_of(sp, {"bank": bank, "router": initial["router"] | {"w1": w1}}, x)
    params = {"lora_a": bank["v"], "lora_b": bank["u"], "router": w1}
    moe = LoRAMoE(EXPERTS, RANK)
    assert moe.scale == sp.scale
    np.testing.assert_allclose(delta_of(moe, params, x)[0], theirs, rtol=1e-5, atol=1e-6)


def test_initialization():
    """A and the router uniform in ±1/√I, B zero."""
    kernel = np.zeros((400, 30), "f")
    params, _ = jax.jit(LoRAMoE(EXPERTS, 8).init)(jax.random.key(0), kernel)
    for name in ("lora_a", "router"):
        assert np.abs(params[name]).max() == pytest.approx(1 / 20, rel=0.01)
        assert np.std(params[name]) == pytest.approx(1 / 20 / 3**0.5, rel=0.05)
    assert not np.any(params["lora_b"])


def test_padding_only(x):
    """Losses and their gradients are 0, not NaN."""
    mask = np.zeros(x.shape[:-1], bool)

    def losses(params):
        return sum(ALL[0].delta(params, 1e3 * x, token_mask=mask)[1].losses.values())

    value, gradients = jax.jit(jax.value_and_grad(losses))(arrays())
    assert value == 0
    assert all(not np.any(leaf) for leaf in jax.tree.leaves(gradients))


def test_logits_are_fp32_for_bfloat16_inputs(x):
    """The delta is bf16, and the losses are exact for the rounded inputs."""
    low = x.astype(jnp.bfloat16)
    delta, aux = delta_of(ALL[0], arrays(), low)
    assert delta.dtype == jnp.bfloat16
    router = arrays()["router"].astype(jnp.bfloat16).astype("f")
    logits = low.astype("f") @ router
    assert aux.losses["z"].dtype == jnp.float32
    exact = lambda x: (z_loss(x, None), balance_loss(jax.nn.softmax(x), None))  # noqa: E731
    actual = aux.losses["z"], aux.losses["balance"]
    np.testing.assert_allclose(actual, jax.jit(exact)(logits), rtol=1e-5)
    task = jax.grad(lambda params, x: TOP1[1].delta(params, x)[0].sum(), argnums=(0, 1))
    param_grads, x_grad = jax.eval_shape(task, arrays(), low)
    assert {leaf.dtype for leaf in jax.tree.leaves(param_grads)} == {jnp.dtype("float32")}
    assert x_grad.dtype == jnp.bfloat16


@pytest.mark.parametrize("experts", [1, 4, 7])
def test_softmax(experts):
    """Values and gradients, also of large logits; no reduction for XLA to fuse."""
    logits, weights = 30 * normal(0, 5, 3, experts), normal(1, 5, 3, experts)

    def value_and_gradient(f, x):
        y, vjp = jax.vjp(f, x)
        return y, *vjp(weights)

    run = jax.jit(lambda x: [value_and_gradient(f, x) for f in (softmax, jax.nn.softmax)])
    (y, gradient), (expected, d_expected) = run(logits)
    np.testing.assert_allclose(y, expected, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(gradient, d_expected, rtol=1e-5, atol=1e-5)
    assert "reduce" not in str(jax.make_jaxpr(softmax)(logits))
