"""Verbs on a chain and a state: compiled, and what they are given looked at while jax traces, so
that a call pays nothing for it."""

import functools
import inspect
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from svkc._jax.eager import eager_jit
from svkc.model.chain import Chain, State, Structure
from svkc.model.validation import real_array


def check_chain(chain) -> None:
    """ValueError for what is no chain."""
    if not isinstance(chain, Chain):
        raise ValueError(f"chain: expected what svkc.load(...) gives, got {type(chain).__name__}")


def check_state(chain, state) -> None:
    """ValueError for what is no state of this chain, by its sizes and types."""
    check_chain(chain)
    if not isinstance(state, State) or not isinstance(state.structure, Structure):
        raise ValueError(f"state: expected what chain.state(...) gives, got {type(state).__name__}")
    sizes = (
        ("q", state.q, chain.topology.nq_all),
        ("v", state.v, chain.dofs),
        ("connected", state.structure.connected, len(chain.link_names)),
    )
    for name, value, size in sizes:
        shape = getattr(value, "shape", None)
        if shape != (size,):
            raise ValueError(
                f"state.{name}: got shape {shape}, expected ({size},); for many states use vmap or"
                " svkc.rollout"
            )
    for value in (state.q, state.v):
        dtype = real_array("state", value).dtype
        if dtype != chain.q_load.dtype:
            raise ValueError(
                f"state.q is {dtype}, the chain is {chain.q_load.dtype}; load and state must be"
                " made with the same precision"
            )


def _validated(given: dict) -> dict:
    """The arguments by name, arrays made of what is one; ValueError for what cannot be right."""
    chain = given["chain"]
    check_chain(chain)
    if "state" in given:
        check_state(chain, given["state"])
    sizes = dict.fromkeys(("q", "q1", "q2"), chain.topology.nq_all) | {"dv": chain.dofs}
    return given | {
        name: float_vector(chain, name, given[name], sizes.get(name))
        for name in given.keys() - {"chain", "state"}
    }


def float_vector(chain: Chain, name: str, value, size: int | None = None):
    """An array of real numbers, of this size (None: of any), in the chain's float type where it is
    in none; ValueError for another."""
    array = real_array(name, value)
    if size is not None and array.shape != (size,):
        raise ValueError(f"{name}: got shape {array.shape}, expected ({size},); for many use vmap")
    return (
        array
        if isinstance(array, jax.Array) and jnp.issubdtype(array.dtype, jnp.floating)
        else jnp.asarray(array, chain.q_load.dtype)
    )


def checked_jit(fn: Callable | None = None, *, eager: bool = False) -> Callable:
    """`jax.jit` for a function of a chain, a state and arrays; ValueError where one of them cannot
    be right.

    eager: called outside of every transformation it is compiled for compile time (`eager_jit`).
    """
    if fn is None:
        return functools.partial(checked_jit, eager=eager)
    signature = inspect.signature(fn)

    @functools.wraps(fn)
    def looked_at(*args, **options):
        return fn(**_validated(signature.bind(*args, **options).arguments))

    compiled = eager_jit(looked_at) if eager else jax.jit(looked_at)

    @functools.wraps(fn)
    def call(*args, **options):
        try:
            return compiled(*args, **options)
        except (TypeError, OverflowError):
            # jax could not take an argument in: say which
            _validated(signature.bind(*args, **options).arguments)
            raise

    return call


def joint_torques(chain: Chain, tau) -> Float[Array, " dofs"]:
    """Torques over every coordinate; those of virtual joints are zero where only the tree's are
    given. ValueError: another size."""
    if tau.shape == (chain.dofs,):
        return tau
    if tau.shape == (chain.nv,):
        return jnp.concatenate([tau, jnp.zeros(chain.dofs - chain.nv, tau.dtype)])
    raise ValueError(
        f"tau: got shape {tau.shape}, expected {chain.dofs} joint torques (or {chain.nv}, the"
        " tree's)"
    )
