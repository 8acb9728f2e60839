"""Test how the benchmark of kernels sorts them, and its arithmetic."""

import jax
import jax.numpy as jnp
import pytest

from benchmarks import kernels

PROGRAM = """HloModule jit_train_step, is_scheduled=true

%joined (p.0: bf16[8,4], p.1: bf16[8,2]) -> bf16[8,6] {
  %p.0 = bf16[8,4]{1,0} parameter(0)
  %p.1 = bf16[8,2]{1,0} parameter(1)
  ROOT %concatenate.1 = bf16[8,6]{1,0} concatenate(%p.0, %p.1), dimensions={1}
}

%saved (p.2: f32[6,8], p.3: f32[8], p.4: s32[]) -> f32[6,8] {
  %p.2 = f32[6,8]{1,0} parameter(0)
  %p.3 = f32[8]{0} parameter(1)
  %p.4 = s32[] parameter(2)
  %c.1 = s32[] constant(5)
  %layer = s32[] subtract(%c.1, %p.4)
  ROOT %update.1 = f32[6,8]{1,0} dynamic-update-slice(%p.2, %p.3, %layer, %c.1)
}

%product (p.5: bf16[6,8,8]) -> (bf16[8,8], s8[64]) {
  %p.5 = bf16[6,8,8]{2,1,0} parameter(0)
  %slice.1 = bf16[8,8]{1,0} slice(%p.5), slice={[0:1], [0:8], [0:8]}
  ROOT %c.2 = (bf16[8,8]{1,0}, s8[64]{0}) custom-call(%slice.1), custom_call_target="__cublas$gemm"
}

%normed (p.6: f32[8]) -> f32[] {
  %p.6 = f32[8]{0} parameter(0)
  ROOT %reduce.1 = f32[] reduce(%p.6, %p.6), to_apply=%add
}

%gated (p.7: f32[8]) -> f32[8] {
  %p.7 = f32[8]{0} parameter(0)
  ROOT %tanh.1 = f32[8]{0} tanh(%p.7)
}

ENTRY %main.1 (p.8: f32[8]) -> f32[8] {
  %p.8 = f32[8]{0} parameter(0)
  %mm = (bf16[8,8]{1,0}, s8[64]{0}) custom-call(%p.8), custom_call_target="__cublas$lt$matmul"
  %mm8 = (bf16[8,8]{1,0}, s8[64]{0}) custom-call(%p.8), custom_call_target="__cublas$lt$matmul$f8"
  %mms = (bf16[8,8]{1,0}, s8[64]{0}) fusion(%p.8), kind=kCustom, calls=%product
  %att = bf16[8]{0} custom-call(%p.8), custom_call_target="__cudnn$fmhaSoftmax"
  %gate = bf16[8]{0} custom-call(%p.8), custom_call_target="__gpu$xla.gpu.triton", \
metadata={op_name="jit(train_step)/jvp()/rowwise_kernel/pallas_call"}
  %short = bf16[8]{0} custom-call(%p.8), custom_call_target="__gpu$xla.gpu.triton", \
metadata={op_name="jit(train_step)/jvp()/short_attention/pallas_call"}
  %xz = bf16[8,6]{1,0} fusion(%p.8), kind=kLoop, calls=%joined
  %stack = f32[6,8]{1,0} fusion(%p.8), kind=kLoop, calls=%saved
  %norm = f32[] fusion(%p.8), kind=kInput, calls=%normed, \
metadata={op_name="jit(train_step)/jvp()/reduce_sum"}
  %clip = f32[] fusion(%p.8), kind=kInput, calls=%normed, \
metadata={op_name="jit(train_step)/reduce_sum"}
  %mean = f32[8]{0} all-reduce(%p.8), to_apply=%add
  ROOT %act = f32[8]{0} fusion(%p.8), kind=kLoop, calls=%gated, \
metadata={op_name="jit(train_step)/transpose(jvp())/mul"}
}
"""


@pytest.mark.parametrize(
    ("name", "kind"),
    {
        "mm": "matmuls",
        "mms": "matmuls",
        "mm8": "matmuls in float8",
        "att": "attention",
        "short": "attention",
        "gate": "router and gate",
        "xz": "joins",
        "stack": "copies",
        "norm": "norms and sums",
        "clip": "optimizer",
        "mean": "collectives",
        "act": "elementwise",
    }.items(),
)
def test_kinds(name, kind):
    assert kernels.kind(kernels.instructions(PROGRAM)[name]) == kind


@pytest.mark.parametrize(
    ("spans", "length"),
    [([], 0), ([(3, 5)], 2), ([(6, 9), (1, 4), (2, 3), (3, 7)], 8), ([(1, 2), (4, 6)], 3)],
)
def test_overlapping_kernels_count_once(spans, length):
    assert kernels.covered(spans) == length


# A type of JAX's has no module; as an error, this warning aborts the process.
@pytest.mark.filterwarnings("ignore:builtin type event_stats:DeprecationWarning")
def test_profile():
    """On a CPU, the profiler records the operations of a program with their names."""
    x = jnp.ones((256, 256))
    compiled = jax.jit(lambda x: jnp.tanh(x @ x) @ x).lower(x).compile()

    class Step:
        calls = 0

        def __call__(self):
            self.calls += 1
            return compiled(x)

    step = Step()
    step.compiled = compiled  # type: ignore[attr-defined]
    by_kind, slowest = kernels.profile(step, 3)  # type: ignore[arg-type]
    assert step.calls == 2 + 3
    found = {row["kind"]: row for row in by_kind}
    assert found["matmuls"]["kernels"] >= 2
    assert found["idle"]["kernels"] == 0
    busy = sum(row["%"] for row in by_kind)
    assert 99.9 < busy < 400  # kernels may overlap
    assert sum(row["ms"] for row in slowest) == pytest.approx(
        sum(row["ms"] for row in by_kind) - found["idle"]["ms"]
    )


def test_xla_knows_the_options():
    jax.jit(jnp.sin).lower(1.0).compile(kernels.WITHOUT_GRAPHS)
