"""Energy and momentum of the tree. Virtual links have no mass and take no part."""

from dataclasses import replace
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float

from svkc._jax.select import where
from svkc.model.chain import Chain, State, active_dofs
from svkc.model.checked_jit import checked_jit
from svkc.tree.configuration import difference
from svkc.tree.kinematics import Kinematics, kinematics, twists
from svkc.tree.spatial import cross, matvec

# of each row: the results of `body_motions`
BodyMotions: TypeAlias = tuple[
    Float[Array, "rows 3"], Float[Array, "rows 3"], Float[Array, "rows 3"], Float[Array, "rows 3"]
]


def body_motions(chain: Chain, kin: Kinematics, v: Float[Array, " dofs"]) -> BodyMotions:
    """Return of each row its centre of mass and that point's velocity, w, and I w.

    Centres of mass are given from the root's origin; I w is the angular momentum about the centre
    of mass. All are in world axes.
    """
    V = twists(chain, kin, v)
    c = kin.r + matvec(kin.R, chain.com)
    w = V[:, :3]
    spin = matvec(kin.R, matvec(chain.symmetric_inertia, matvec(jnp.swapaxes(kin.R, -1, -2), w)))
    return c, V[:, 3:] + cross(w, c), w, spin


def kinetic_of_bodies(
    chain: Chain, v: Float[Array, " dofs"], bodies: BodyMotions
) -> Float[Array, ""]:
    """Return the kinetic energy (J), armature included."""
    _, u, w, spin = bodies
    kinetic = jnp.sum(chain.mass * jnp.sum(u * u, -1)) / 2 + jnp.sum(w * spin) / 2
    if chain.armature is None:
        return kinetic
    return kinetic + jnp.sum(chain.armature * v[: chain.nv] ** 2) / 2


def _energies(
    chain: Chain, state: State, kin: Kinematics, bodies: BodyMotions
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the kinetic and the potential energy."""
    kinetic, c = kinetic_of_bodies(chain, state.v, bodies), bodies[0]
    potential = -jnp.sum(chain.mass * jnp.sum((kin.root_position + c) * chain.gravity[None], -1))
    if chain.stiffness is not None:
        stretch = difference(chain, chain.q_spring, state.q)
        # the springs of cut joints are gone; those of locked joints stay stretched
        existing = active_dofs(chain, replace(state.structure, locked=None))
        stretch = where(existing, stretch, 0)
        potential = potential + jnp.sum(chain.stiffness * stretch**2) / 2
    return kinetic, potential


def _kinetic_and_potential(chain: Chain, state: State) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the kinetic and the potential energy (J)."""
    kin = kinematics(chain, state.q)
    return _energies(chain, state, kin, body_motions(chain, kin, state.v))


@checked_jit(eager=True)
def kinetic_energy(chain: Chain, state: State) -> Float[Array, ""]:
    """Return the kinetic energy v^T M v / 2 (J), armature included."""
    return _kinetic_and_potential(chain, state)[0]


@checked_jit(eager=True)
def potential_energy(chain: Chain, state: State) -> Float[Array, ""]:
    """Return the potential energy of gravity and of the joints' springs (J).

    Gravity's potential is zero at the world's origin.
    """
    return _kinetic_and_potential(chain, state)[1]


@checked_jit(eager=True)
def energy(chain: Chain, state: State) -> Float[Array, ""]:
    """Return the mechanical energy (J): kinetic plus potential (Featherstone section 2.13)."""
    kinetic, potential = _kinetic_and_potential(chain, state)
    return kinetic + potential


def energy_and_momentum(
    chain: Chain, state: State, kin: Kinematics, bodies: BodyMotions
) -> tuple[Float[Array, ""], Float[Array, "3"], Float[Array, "3"]]:
    """Return `energy` (J), linear momentum (N s) and angular momentum (N m s).

    Angular momentum is taken about the centre of mass of all bodies; both are in world axes.
    """
    kinetic, potential = _energies(chain, state, kin, bodies)
    c, u, _, spin = bodies
    p, position = chain.mass[:, None] * u, kin.root_position + c
    center = jnp.sum(chain.mass[:, None] * position, 0) / jnp.sum(chain.mass)
    return kinetic + potential, jnp.sum(p, 0), jnp.sum(spin + cross(position - center[None], p), 0)


class Momentum(NamedTuple):
    """Momentum of all bodies in world axes.

    linear: N s.
    angular: about the world's origin (N m s).
    """

    linear: Float[Array, "3"]
    angular: Float[Array, "3"]


@checked_jit(eager=True)
def momentum(chain: Chain, state: State) -> Momentum:
    """Return the linear momentum (N s) and the angular momentum (N m s) of all bodies.

    Angular momentum is taken about the world's origin; both are in world axes (Featherstone
    section 2.12).
    """
    kin = kinematics(chain, state.q)
    c, u, _, spin = body_motions(chain, kin, state.v)
    p = chain.mass[:, None] * u
    angular = jnp.sum(spin + cross(kin.root_position + c, p), 0)
    return Momentum(jnp.sum(p, 0), angular)
