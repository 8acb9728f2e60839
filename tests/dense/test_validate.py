"""Invalid arguments of lower-level functions raise one-sentence errors."""

import re

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters.adaptation import count, penalties
from lorasp_jax.adapters.compress import calibration
from lorasp_jax.dense import LinenDense, dense
from lorasp_jax.peft import AdaLoRA, LoRA, LoRAMoE, LoRASP

X, KERNEL, KEY = jnp.ones((3, 5)), jnp.ones((5, 4)), jax.random.key(0)
METHOD, MOE = LoRA(rank=2), LoRAMoE(rank=2, experts=2)
PARAMS, MOE_PARAMS = (method.init(KEY, KERNEL)[0] for method in (METHOD, MOE))
NET = nnx.Linear(5, 4, rngs=nnx.Rngs(0))
SHAPES = nnx.eval_shape(lambda: nnx.Linear(5, 4, rngs=nnx.Rngs(0)))
LINEN = lorasp_jax.LinenAdapter(nn.Dense(4), [(".*", METHOD)])
VARIABLES = LINEN.init(KEY, X)
SP = lorasp_jax.adapt(NET, [(".*", LoRASP(rank=4, hidden_width=2))], rngs=nnx.Rngs(0))


def named():
    models = [lorasp_jax.adapt(NET, [(".*", METHOD)], rngs=nnx.Rngs(seed)) for seed in (0, 1)]
    return lorasp_jax.combine(dict(zip("ab", models, strict=True)))


def with_kernel(value):
    return VARIABLES | {"params": VARIABLES["params"] | {"kernel": value}}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        # methods
        (lambda: METHOD.init(0, KERNEL), "key must be a PRNG key such as jax.random.key(0), got 0"),
        (lambda: METHOD.init(nnx.Rngs(0), KERNEL), "key must be a PRNG key such as"),
        (lambda: METHOD.init(KEY, PARAMS), "a floating-point kernel [I, O], got dict"),
        # layers
        (
            lambda: dense(X[:, 1:], KERNEL, None, PARAMS, METHOD),
            "width 4 does not match kernel shape [5, 4]",
        ),
        (
            lambda: dense(X, KERNEL, None, {}, METHOD),
            "lora for a kernel [5, 4] needs lora_a [5, 2]",
        ),
        # The scale α/R would be that of a different rank.
        (
            lambda: dense(X, KERNEL, None, PARAMS, LoRA(rank=3, alpha=2.0)),
            "lora for a kernel [5, 4] needs lora_a [5, 3], got [5, 2]",
        ),
        # A mask of length 1 would broadcast to three tokens.
        (
            lambda: dense(X, KERNEL, None, MOE_PARAMS, MOE, token_mask=jnp.ones(1, bool)),
            "token_mask must be bool [3], got bool [1]",
        ),
        (
            lambda: dense(X, KERNEL, None, MOE_PARAMS, MOE, token_mask=np.ones(3)),
            "token_mask must be bool [3], got float64 [3]",
        ),
        (
            lambda: AdaLoRA(rank=2).transform(optax.sgd(0.1), 1.5),
            "total_steps must be an integer from 1 to 2147483647, got 1.5",
        ),
        # Linen
        (lambda: LINEN.init(0, X), "key must be a PRNG key such as jax.random.key(0), got 0"),
        (lambda: LINEN.attach(None, VARIABLES["params"], X), 'a dict whose "params" is a dict'),
        (lambda: LINEN.attach(None, {"params": {}}, X), "key must be a PRNG key such as"),
        (
            lambda: LINEN.apply(with_kernel(None), X),
            '"params" must hold arrays, got None at kernel',
        ),
        (lambda: LINEN.merge(with_kernel("x"), X), "must hold arrays, got 'x' at kernel"),
        (
            lambda: LinenDense(4, param_dtype=int).init(KEY, X),
            "param_dtype must be a floating-point dtype",
        ),
        # models
        (lambda: count(5), "the model must be an NNX module, got int"),
        (lambda: penalties(None), "the model must be an NNX module, got NoneType"),
        (lambda: lorasp_jax.prune(SP, [X[:0]]), "the batches have no valid tokens"),
        (lambda: lorasp_jax.prune(SP, [X * jnp.nan]), "the model's outputs are not finite"),
        (lambda: calibration.input_moments(NET, [X], b"a"), "list of (pattern"),
        (lambda: calibration.input_moments(SHAPES, [X]), "the model holds shapes without values"),
        (lambda: lorasp_jax.swap(named(), "a", SHAPES), "the model holds shapes without values"),
        (lambda: lorasp_jax.choose(named(), np.ones((0, 2))), "weights must be [2]"),
        (lambda: lorasp_jax.choose(named(), ["a", "b"])(X), "for 2 examples do not fit 3"),
    ],
)
def test_one_sentence(call, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        call()
