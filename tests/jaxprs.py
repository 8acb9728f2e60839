"""Inspect traced programs, independently of how they are split into functions."""

import jax


def primitives(function, *arguments):
    """Return the primitives of a traced function, including those of inner functions per call."""
    return list(_names(jax.make_jaxpr(function)(*arguments).jaxpr))


def _names(jaxpr):
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for inner in jax.tree.leaves(list(equation.params.values())):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                yield from _names(inner)
