"""Inspect traced programs, independently of how they are split into functions."""

import jax


def primitives(function, *arguments):
    """Return the primitives of a traced function, including those of inner functions per call."""
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    return [equation.primitive.name for equation in equations(jaxpr)]


def equations(jaxpr):
    """Yield the equations of a traced function, including those of inner functions per call."""
    for equation in jaxpr.eqns:
        yield equation
        for inner in jax.tree.leaves(list(equation.params.values())):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                yield from equations(inner)
