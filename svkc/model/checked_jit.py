"""`jax.jit` for functions of a chain and a state, with validation of the arguments while JAX
traces, so that a compiled call pays nothing for the validation."""

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, overload

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from svkc._jax.eager import eager_jit
from svkc.model.annotations import Torques
from svkc.model.chain import Chain, State, Structure
from svkc.model.inertial_parameters import check_inertial_parameters
from svkc.model.validation import real_array


def check_chain(chain: Any) -> None:
    """Raise ValueError if `chain` is not a `Chain`, or has an invalid mass, inertia or armature."""
    if not isinstance(chain, Chain):
        raise ValueError(
            f"chain: expected a Chain, as svkc.load(...) returns, got {type(chain).__name__}"
        )
    check_inertial_parameters(chain)


def check_state(chain: Any, state: Any) -> None:
    """Raise ValueError if `state` is not a state of this chain, by its shapes and dtypes."""
    check_chain(chain)
    if not isinstance(state, State) or not isinstance(state.structure, Structure):
        raise ValueError(
            f"state: expected a State, as chain.state(...) returns, got {type(state).__name__}"
        )
    expected = (
        ("q", state.q, chain.topology.nq_all),
        ("v", state.v, chain.dofs),
        ("structure.connected", state.structure.connected, len(chain.link_names)),
    )
    for name, value, size in expected:
        shape = getattr(value, "shape", None)
        if shape != (size,):
            raise ValueError(
                f"state.{name}: got shape {shape}, expected ({size},); use vmap or svkc.rollout"
                " for a batch"
            )
    for name, value in (("q", state.q), ("v", state.v)):
        dtype = real_array(f"state.{name}", value).dtype
        if dtype != chain.q_load.dtype:
            raise ValueError(
                f"state.{name} is {dtype}, the chain is {chain.q_load.dtype}; load and state must"
                " be made with the same precision"
            )


def _validated(arguments: dict, static: tuple[str, ...] = ()) -> dict:
    """Return the arguments by name, converted to arrays unless static.

    Raises ValueError for an invalid argument.
    """
    chain = arguments["chain"]
    check_chain(chain)
    if "state" in arguments:
        check_state(chain, arguments["state"])
    lengths = dict.fromkeys(("q", "q1", "q2"), chain.topology.nq_all) | {"dv": chain.dofs}
    lengths |= dict.fromkeys(("point", "force", "torque"), 3)
    return arguments | {
        name: chain.torques(arguments[name])
        if name == "tau" and isinstance(arguments[name], Mapping)
        else float_vector(chain, name, arguments[name], lengths.get(name))
        for name in arguments.keys() - {"chain", "state", *static}
    }


def float_vector(chain: Chain, name: str, value: Any, size: int | None = None) -> Array:
    """Return a value as a floating-point array, of the chain's dtype unless a floating JAX array.

    name: the argument's name, for messages.
    size: the expected length; None: any shape.

    Raises ValueError if the value is not real or has another length.
    """
    array = real_array(name, value)
    if size is not None and array.shape != (size,):
        raise ValueError(
            f"{name}: got shape {array.shape}, expected ({size},); use vmap for a batch"
        )
    return (
        array
        if isinstance(array, jax.Array) and jnp.issubdtype(array.dtype, jnp.floating)
        else jnp.asarray(array, chain.q_load.dtype)
    )


_Result = TypeVar("_Result")


@overload
def checked_jit(fn: Callable[..., _Result]) -> Callable[..., _Result]: ...
@overload
def checked_jit(
    *, eager: bool = False, static: tuple[str, ...] = ()
) -> Callable[[Callable[..., _Result]], Callable[..., _Result]]: ...
def checked_jit(
    fn: Callable | None = None, *, eager: bool = False, static: tuple[str, ...] = ()
) -> Any:
    """Wrap a function of a chain, a state and arrays in `jax.jit`, and validate its arguments.

    eager: outside of all transformations, compile for short compile time (`eager_jit`).
    static: names of keyword-only arguments that are static. The function validates them itself.

    The wrapped function raises ValueError for an invalid argument.
    """
    if fn is None:
        return functools.partial(checked_jit, eager=eager, static=static)
    signature = inspect.signature(fn)

    @functools.wraps(fn)
    def with_validation(*args, **options):
        return fn(**_validated(signature.bind(*args, **options).arguments, static))

    compiled = (
        eager_jit(with_validation) if eager else jax.jit(with_validation, static_argnames=static)
    )

    @functools.wraps(fn)
    def call(*args, **options):
        chain = args[0] if args else options.get("chain")
        # a compiled program validates shapes only
        if isinstance(chain, Chain):
            check_inertial_parameters(chain)
        try:
            return compiled(*args, **options)
        except (TypeError, OverflowError):
            # JAX rejected an argument: validation says which
            _validated(signature.bind(*args, **options).arguments, static)
            raise

    return call


def torques_over_dofs(chain: Chain, tau: Torques) -> Float[Array, " dofs"]:
    """Return torques [dofs] over every coordinate, with zeros for virtual joints if tau is [nv].

    Raises ValueError if tau has another length, or is a dict with unknown names.
    """
    if isinstance(tau, Mapping):
        return chain.torques(tau)
    tau = jnp.asarray(tau)
    if tau.shape == (chain.dofs,):
        return tau
    if tau.shape == (chain.nv,):
        return jnp.concatenate([tau, jnp.zeros(chain.dofs - chain.nv, tau.dtype)])
    raise ValueError(
        f"tau: got shape {tau.shape}, expected {chain.dofs} joint torques (or {chain.nv}, the"
        " tree's)"
    )
