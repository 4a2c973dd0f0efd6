"""Compilation of functions that are called eagerly, once or a few times.

The compiler options here trade execution time for compile time.
"""

import functools
import re
from collections.abc import Callable

import jax

try:
    from jax.core import trace_state_clean  # pyright: ignore[reportAttributeAccessIssue]
except ImportError:
    # JAX has no other public way to ask whether it is tracing
    from jax._src.core import trace_state_clean

# LLVM's optimization and the fusion emitters take most of XLA's compile time on a CPU
_FAST_COMPILE_OPTIONS = {
    "xla_backend_optimization_level": 0,
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": 1,
}


def eager_jit(function: Callable, jit: Callable = jax.jit) -> Callable:
    """Wrap a function in `jit` so that an eager call compiles fast; the compiled code is slower.

    JAX accepts compiler options at the outermost jit only. Under jit, grad, vmap and scan the
    function is therefore compiled without them. Options that the installed jaxlib does not know are
    dropped.

    jit: `jax.jit` or `equinox.filter_jit`.
    """
    optimized, fast_compiled = jit(function), {}

    @functools.wraps(function)
    def call(*args, **kw):
        if not trace_state_clean() or jax.default_backend() != "cpu":
            return optimized(*args, **kw)
        while True:
            options = tuple(_FAST_COMPILE_OPTIONS)
            if options not in fast_compiled:
                # JAX caches programs by the wrapper, so each set of options has its own wrapper
                fast_compiled[options] = jit(function, compiler_options=dict(_FAST_COMPILE_OPTIONS))
            try:
                return fast_compiled[options](*args, **kw)
            except Exception as error:
                if not _drop_unknown_option(str(error)):
                    raise

    return call


def _drop_unknown_option(message: str) -> bool:
    """Drop the option that an error message calls unknown; return whether there was one."""
    unknown = re.search(r"[Nn]o such compile option: '?(\w+)", message)
    return unknown is not None and _FAST_COMPILE_OPTIONS.pop(unknown[1], None) is not None
