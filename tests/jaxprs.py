"""Trace programs for other devices, and inspect them independently of their functions."""

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


def target(platform, kind=""):
    """Trace for this platform, by default a device of no known kind, on a host without it."""
    device = jax.sharding.AbstractDevice(kind, num_cores=None, platform=platform)
    return jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), (), abstract_device=device))
