"""Compilation of functions that are called eagerly, once or a few times: for compile time, not for
speed."""

import functools
import re
from collections.abc import Callable

import jax

try:
    from jax.core import trace_state_clean  # pyright: ignore[reportAttributeAccessIssue]
except ImportError:
    # not public in every release of jax, and nothing public says whether jax is tracing
    from jax._src.core import trace_state_clean

# LLVM's optimization and the fusion emitters take most of XLA's compile time on a CPU
_FAST_COMPILE_OPTIONS = {
    "xla_backend_optimization_level": 0,
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": 1,
}


def eager_jit(function: Callable, jit: Callable = jax.jit) -> Callable:
    """Wrap a function in `jit` (`jax.jit` or `equinox.filter_jit`) so that an eager call compiles
    fast, and its code runs slower.

    jax accepts compiler options at the outermost jit only. Under jit, grad, vmap and scan the
    function is therefore compiled without them. Options that the installed jaxlib does not know are
    left out.
    """
    plain, quick = jit(function), {}

    @functools.wraps(function)
    def call(*args, **kw):
        if not trace_state_clean() or jax.default_backend() != "cpu":
            return plain(*args, **kw)
        while True:
            known = tuple(_FAST_COMPILE_OPTIONS)
            if known not in quick:
                # jax caches programs by the wrapper, so there is one for each set of options
                quick[known] = jit(function, compiler_options=dict(_FAST_COMPILE_OPTIONS))
            try:
                return quick[known](*args, **kw)
            except Exception as error:
                if not _drop_unknown_option(str(error)):
                    raise

    return call


def _drop_unknown_option(message: str) -> bool:
    """Leave out the option that the message says is unknown; False where it says something else."""
    unknown = re.search(r"[Nn]o such compile option: '?(\w+)", message)
    return unknown is not None and _FAST_COMPILE_OPTIONS.pop(unknown[1], None) is not None
