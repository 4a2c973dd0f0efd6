"""Bricard's rectangular mechanism, IFToMM's A04, against Lagrange's equation of its one freedom.

Five rods along the edges of a cube and six hinges. One row of the loop is redundant in every
configuration.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import svkc

pytestmark = pytest.mark.slow

CORNERS = np.array([(0, 0, 0), (1, 0, 0), (1, 0, 1), (1, 1, 1), (0, 1, 1), (0, 1, 0)], float)
AXES = [np.cross(CORNERS[k] - CORNERS[k - 1], CORNERS[(k + 1) % 6] - CORNERS[k]) for k in range(6)]
ROD_INERTIA, GRAVITY = 1e-13, 9.81


def numbers(x):
    """Return numbers as MJCF writes them."""
    return " ".join(map(str, x))


def mechanism():
    """Return the mechanism at its start along the edges of the cube."""
    nested = ""
    for k in reversed(range(5)):
        edge = CORNERS[k + 1] - CORNERS[k]
        inertia = (1 - edge**2) / 12 + ROD_INERTIA
        inertial = (
            f'<inertial pos="{numbers(edge / 2)}" mass="1" diaginertia="{numbers(inertia)}"/>'
        )
        start = CORNERS[k] - CORNERS[max(k - 1, 0)]
        nested = (
            f'<body name="rod{k}" pos="{numbers(start)}"><joint name="hinge{k}"'
            f' axis="{numbers(AXES[k])}"/>{inertial}{nested}</body>'
        )
    last = svkc.VirtualLink(
        "last",
        parent="world",
        real="rod4",
        joint="hinge",
        axis=tuple(AXES[5]),
        pos=tuple(CORNERS[5]),
        real_pos=tuple(CORNERS[5] - CORNERS[4]),
        connected=True,
    )
    return svkc.load(
        f'<mujoco><option gravity="0 {-GRAVITY} 0"/><worldbody>{nested}</worldbody></mujoco>',
        virtual_links=[last],
    )


def rotation_matrix(axis, angle):
    """Return the rotation about a unit axis, by Rodrigues' formula."""
    cross = jnp.array(np.cross(np.eye(3), axis))
    return jnp.eye(3) + jnp.sin(angle) * cross + (1 - jnp.cos(angle)) * cross @ cross


def angles(a):
    """Return the angles of the hinges for the first one, a.

    Bricard's relation, with angles counted from the cube: sin a + sin b = sin a sin b.
    """
    b = jnp.arcsin(jnp.sin(a) / (jnp.sin(a) - 1))
    return jnp.stack([a, b, a, b, a])


def corners(a):
    """Return the positions of the corners (m) for the first angle."""
    position, frame, positions = jnp.zeros(3), jnp.eye(3), [jnp.zeros(3)]
    for k, angle in enumerate(angles(a)):
        frame = frame @ rotation_matrix(AXES[k], angle)
        position = position + frame @ jnp.array(CORNERS[k + 1] - CORNERS[k])
        positions.append(position)
    return jnp.stack(positions)


def reference_angles(times):
    """Return the first hinge's angle at each time, by Lagrange's equation.

    The kinetic energy of a thin rod with end velocities x', y' is (x'x' + x'y' + y'y') / 6.
    """

    def inertia(a):
        rate = jax.jacfwd(corners)(a)
        return sum(x @ x + x @ y + y @ y for x, y in zip(rate[:-1], rate[1:], strict=True)) / 3

    def height(a):
        return sum((corners(a)[:-1, 1] + corners(a)[1:, 1]) / 2)

    @jax.jit
    def rates(y):
        a, rate = y
        return jnp.stack(
            [
                rate,
                -(jax.grad(inertia)(a) * rate**2 / 2 + GRAVITY * jax.grad(height)(a)) / inertia(a),
            ]
        )

    return solve_ivp(
        lambda t, y: np.asarray(rates(y)),
        (0, times[-1]),
        [0.0, 0.0],
        method="DOP853",
        t_eval=times,
        rtol=1e-12,
        atol=1e-13,
    ).y[0]


@pytest.mark.parametrize(
    "dynamics",
    [svkc.dynamics.CompositeBodies(), svkc.dynamics.ArticulatedBodies()],
    ids=["pivots", "bodies"],
)
def test_bricards_mechanism(dynamics):
    """Ten seconds agree with the reference to 1e-8 rad, and the mobility is one."""
    chain, times = mechanism(), jnp.linspace(0, 10, 101)
    traj = svkc.simulate(chain, chain.state(), 10.0, ts=times, rtol=1e-11, dynamics=dynamics)
    np.testing.assert_allclose(
        traj.states.q[:, :5], jax.vmap(angles)(jnp.array(reference_angles(times))), atol=1e-8
    )
    assert np.min(traj.states.q[:, 0]) < -3
    assert svkc.mobility(chain, traj.final).freedoms == 1
