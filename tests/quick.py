"""jit for tests of values: compiles about four times faster, the program is a little slower."""

import functools

import jax

jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
