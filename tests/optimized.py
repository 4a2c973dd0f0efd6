"""A jit for long computations: the tests' process compiles without optimization (conftest.py)."""

import jax


def optimized_jit(function):
    """Return the function compiled with XLA's optimizations.

    Compilation takes about twice as long, so it is for programs that run longer than they compile.
    """
    return jax.jit(function, compiler_options={"xla_backend_optimization_level": 1})
