"""Energy and momentum of the tree; virtual links have no mass."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from svkc.model.chain import Chain, State, active_dofs
from svkc.model.checked_jit import checked_jit
from svkc.tree.configuration import difference
from svkc.tree.kinematics import Kinematics, kinematics, twists
from svkc.tree.spatial import cross, matvec


def _body_motions(chain: Chain, kin: Kinematics, v):
    """Of each row: centre of mass from the root's origin, its velocity, angular velocity, angular
    momentum about it."""
    V = twists(chain, kin, v)
    c = kin.r + matvec(kin.R, chain.com)
    w = V[:, :3]
    spin = matvec(kin.R, matvec(chain.rotational, matvec(jnp.swapaxes(kin.R, -1, -2), w)))
    return c, V[:, 3:] + cross(w, c), w, spin


def _energies(
    chain: Chain, state: State, kin: Kinematics, bodies
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    c, u, w, spin = bodies
    kinetic = jnp.sum(chain.mass * jnp.sum(u * u, -1)) / 2 + jnp.sum(w * spin) / 2
    if chain.armature is not None:
        kinetic = kinetic + jnp.sum(chain.armature * state.v[: chain.nv] ** 2) / 2
    potential = -jnp.sum(chain.mass * jnp.sum((kin.root_position + c) * chain.gravity[None], -1))
    if chain.stiffness is not None:
        stretch = difference(chain, chain.q_spring, state.q)
        stretch = jnp.where(active_dofs(chain, state.structure), stretch, 0)
        potential = potential + jnp.sum(chain.stiffness * stretch**2) / 2
    return kinetic, potential


def _kinetic_and_potential(chain: Chain, state: State) -> tuple[Float[Array, ""], Float[Array, ""]]:
    kin = kinematics(chain, state.q)
    return _energies(chain, state, kin, _body_motions(chain, kin, state.v))


@checked_jit(eager=True)
def kinetic_energy(chain: Chain, state: State) -> Float[Array, ""]:
    """Kinetic energy (J), armature included: v^T M v / 2."""
    return _kinetic_and_potential(chain, state)[0]


@checked_jit(eager=True)
def potential_energy(chain: Chain, state: State) -> Float[Array, ""]:
    """Gravity's potential (J), zero at the world's origin, and that of the joints' springs."""
    return _kinetic_and_potential(chain, state)[1]


@checked_jit(eager=True)
def energy(chain: Chain, state: State) -> Float[Array, ""]:
    """Mechanical energy (J): kinetic, gravity's and the joint springs' (Featherstone section
    2.13)."""
    kinetic, potential = _kinetic_and_potential(chain, state)
    return kinetic + potential


def energy_and_momentum(
    chain: Chain, state: State, kin: Kinematics
) -> tuple[Float[Array, ""], Float[Array, "3"], Float[Array, "3"]]:
    """Return `energy`, linear momentum (N s), and angular momentum about the centre of mass of all
    bodies (N m s), in world axes."""
    bodies = _body_motions(chain, kin, state.v)
    kinetic, potential = _energies(chain, state, kin, bodies)
    c, u, _, spin = bodies
    p, place = chain.mass[:, None] * u, kin.root_position + c
    centre = jnp.sum(chain.mass[:, None] * place, 0) / jnp.sum(chain.mass)
    return kinetic + potential, jnp.sum(p, 0), jnp.sum(spin + cross(place - centre[None], p), 0)


@checked_jit(eager=True)
def momentum(chain: Chain, state: State) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Linear momentum (N s) and angular momentum about the world's origin (N m s), in world axes
    (Featherstone section 2.12)."""
    kin = kinematics(chain, state.q)
    c, u, _, spin = _body_motions(chain, kin, state.v)
    p = chain.mass[:, None] * u
    return jnp.sum(p, 0), jnp.sum(spin + cross(kin.root_position + c, p), 0)
