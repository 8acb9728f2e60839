"""What a program does, whatever its functions are cut into."""

import jax


def primitives(function, *arguments):
    """Names of all equations of a traced function, those of inner functions at every call."""
    return list(_names(jax.make_jaxpr(function)(*arguments).jaxpr))


def _names(jaxpr):
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for inner in jax.tree.leaves(list(equation.params.values())):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                yield from _names(inner)
