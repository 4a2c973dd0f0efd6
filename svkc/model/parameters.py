"""Parameters of bodies and joints by name: reading and replacing entries of a chain's arrays."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.pytrees import is_concrete
from svkc.model.names import body_index, q_slice, unknown_name, v_slice
from svkc.model.topology import FREE, Topology
from svkc.model.validation import boolean, finite_array

OF_BODIES = ("mass", "com", "inertia", "pos", "quat")
OF_JOINTS = ("axis", "armature", "damping", "stiffness", "q_spring", "limit")

AnyChain = TypeVar("AnyChain")


class BodyParameters(NamedTuple):
    """Parameters of one body.

    mass: kg.
    com: centre of mass in the body's frame (m).
    inertia: rotational inertia about the centre of mass, in the body's axes (kg m^2).
    pos, quat: placement of the body's frame in the parent's at the load pose (m, wxyz). They
        have no effect for a body with a free joint or a cuttable joint.
    """

    mass: Float[Array, ""]
    com: Float[Array, "3"]
    inertia: Float[Array, "3 3"]
    pos: Float[Array, "3"]
    quat: Float[Array, "4"]


def body_parameters(chain: Any, name: str) -> BodyParameters:
    """Return the parameters of a body of a chain; see `Chain.body`."""
    return BodyParameters(
        *(getattr(chain, field)[_entries(chain.topology, field, name)] for field in OF_BODIES)
    )


def with_parameters(
    chain: AnyChain, parameters: Mapping[str, Any], scale_inertia: bool
) -> AnyChain:
    """Return a chain with other parameters; see `Chain.replace`."""
    old = {
        field.name: getattr(chain, field.name)
        for field in dataclasses.fields(chain)  # pyright: ignore[reportArgumentType]
        if field.name in OF_JOINTS or isinstance(getattr(chain, field.name), jax.Array)
    }
    new = {}
    for field, value in parameters.items():
        if field not in old:
            raise unknown_name("parameter", field, sorted(old))
        array = _default_array(chain, field) if old[field] is None else old[field]
        if isinstance(value, Mapping):
            new[field] = _with_entries(chain, field, array, value)
        else:
            new[field] = _as_shape(field, value, array)
    if "limit" in new:
        _check_limit_springs(chain, new)
    if "stiffness" in new and old["q_spring"] is None:
        new.setdefault("q_spring", new.get("q_load", old["q_load"]))
    if boolean("scale_inertia", scale_inertia):
        new["inertia"] = _scaled_inertia(chain, new, parameters)
    return dataclasses.replace(chain, **new)  # pyright: ignore[reportArgumentType]


def _default_array(chain: Any, field: str) -> Array:
    """Return the array of a parameter that the model does not have: zeros, or the load pose.

    Raises ValueError for joint ranges, whose springs the model defines.
    """
    if field == "limit":
        raise ValueError("limit: the model has no joint ranges; load one in which a joint has one")
    if field == "q_spring":
        return chain.q_load
    return jnp.zeros(chain.nv if field == "armature" else chain.dofs, chain.q_load.dtype)


def _check_limit_springs(chain: Any, new: Mapping[str, Any]) -> None:
    """Raise ValueError if a joint gets a range but has no spring that would hold it there."""
    limit, spring = new["limit"], new.get("limit_spring", chain.limit_spring)
    if not is_concrete(limit, spring):
        return
    loose = np.isfinite(np.asarray(limit)).any(0) & (np.asarray(spring) == 0).all(0)
    if np.any(loose):
        name = chain.dof_names[int(np.argmax(loose))]
        raise ValueError(
            f"limit: {name!r} has no joint range in the model, and so no spring that would stop it"
            " at the range's ends; load a model in which it has a range"
        )


def _with_entries(chain: Any, field: str, array: Array, values: Mapping[str, Any]) -> Array:
    """Return an array with the entries of the named bodies or joints set."""
    if field not in (*OF_BODIES, *OF_JOINTS):
        raise ValueError(f"{field}: got names, expected an array of shape {array.shape}")
    for name, value in values.items():
        at = _entries(chain.topology, field, name)
        if field in ("pos", "quat") and chain.topology.kind[at] == FREE:
            raise ValueError(
                f"{field}: body {name!r} is placed by the coordinates of its free joint; give these"
                " to chain.state; the placement of a cuttable joint is in structure.pos and"
                " structure.quat"
            )
        entries = array[at]
        label = f"{field}[{name!r}]"
        value = finite_array(label, value, array.dtype)
        if field == "inertia" and value.shape == (3,):
            value = jnp.diag(value)
        if field in ("axis", "quat"):
            value = value / jnp.linalg.norm(value)
        # one number for a hinge, two for its range
        if value.size == entries.size and value.shape in ((), (1,), (2,)):
            value = value.reshape(entries.shape)
        array = array.at[at].set(_as_shape(label, value, entries))
    return array


def _entries(top: Topology, field: str, name: str) -> Any:
    """Return the index of one body's or joint's entries in an array of the chain."""
    if field in OF_BODIES:
        row = top.body_row[body_index(top, name)]
        # a body with several joints is placed by the row of the first of them
        while field in ("pos", "quat") and row and top.parent[row] not in top.body_row:
            row = top.parent[row]
        return row
    if field == "q_spring":
        return q_slice(top, name)
    at = v_slice(top, name)
    if field == "limit":
        return slice(None), at
    if field in ("axis", "armature") and at.start >= top.nv:
        raise ValueError(f"{field}: {name!r} is a cuttable joint, which has no {field} of its own")
    return top.joint_row[top.joint_names.index(name)] if field == "axis" else at


def _as_shape(label: str, value: Any, like: Array) -> Array:
    """Return a value as an array of another's shape and dtype. Raises ValueError if it has another
    shape or is not finite."""
    value = finite_array(label, value, like.dtype)
    if value.shape != like.shape:
        raise ValueError(
            f"{label}: got an array of shape {value.shape}, expected shape {like.shape}"
        )
    return value


def _scaled_inertia(chain: Any, new: Mapping[str, Any], parameters: Mapping[str, Any]) -> Array:
    """Return the inertias, those of the bodies named in `mass` scaled by the ratio of masses.

    Raises ValueError if no mass is given by name, or if such a body had no mass.
    """
    masses = parameters.get("mass")
    if not isinstance(masses, Mapping):
        raise ValueError("scale_inertia: give `mass` by body name, mass={name: kg}")
    inertia = new.get("inertia", chain.inertia)
    for name in masses:
        row = _entries(chain.topology, "mass", name)
        if is_concrete(chain.mass) and not np.asarray(chain.mass)[row] > 0:
            raise ValueError(f"scale_inertia: body {name!r} has no mass; give its inertia")
        inertia = inertia.at[row].multiply(new["mass"][row] / chain.mass[row])
    return inertia
