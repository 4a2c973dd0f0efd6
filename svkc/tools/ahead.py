"""Programs compiled before they are needed."""

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp


class Program:
    """A compiled function, called like it with arguments of the shapes and dtypes it was made for;
    `TypeError` of jax names those that differ.

    seconds: what making it took, {"lower", "compile"}: tracing and lowering to StableHLO, XLA's
    compilation. temporary_bytes: memory that it needs besides arguments and results (None where the
    backend does not say).
    """

    def __init__(self, program, seconds: dict[str, float]):
        self._program, self.seconds = program, seconds
        memory = program.compiled.memory_analysis()
        self.temporary_bytes: int | None = (
            None if memory is None else int(memory.temp_size_in_bytes)
        )

    def __call__(self, *args: Any, **kw: Any) -> Any:
        return self._program(*args, **kw)

    def __repr__(self) -> str:
        made = ", ".join(f"{name} {value:.1f} s" for name, value in self.seconds.items())
        return f"Program({made}, {self.temporary_bytes} bytes of temporaries)"


def compile(function: Callable, *args: Any, **kw: Any) -> Program:
    """Compiles `function` for arguments like these, without a call: arrays, chains and states, or
    `jax.ShapeDtypeStruct`s in place of arrays.

    `svkc.compile(lambda state: svkc.simulate(chain, state, 1.0), state)(state)` is the run. What is
    not an array is fixed. For the program to be kept
    from one process to the next see jax's persistent cache (docs/measured.md).
    """
    stand_in = lambda x: jnp.zeros(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x
    args, kw = jax.tree.map(stand_in, (args, kw))
    begun = time.perf_counter()
    lowered = eqx.filter_jit(function).lower(*args, **kw)
    done = time.perf_counter()
    program = lowered.compile()
    return Program(program, {"lower": done - begun, "compile": time.perf_counter() - done})
