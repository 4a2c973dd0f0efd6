"""The rows in Delassus' matrix, for every kind of virtual joint."""

import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import REFERENCE, ROUND_OFF

import svkc
from svkc.loops.constraint import loop_kinematics
from svkc.loops.constraint_rows import constraint_rows
from svkc.loops.delassus_rows import delassus_rows
from svkc.loops.forward_dynamics import acceleration

ROWS = {
    "weld": 6,
    "hinge": 5,
    "slide": 5,
    "cylinder": 4,
    "planar": 3,
    "ball": 3,
    (True, False, False, True, False, True): 3,
    # motions along these joints are projected out of all six rows
    "universal": 6,
    "free": 6,
    (True, False, True, False, True, False): 6,
}


def chain_of_joints(joints, spare: int = 0):
    """Return a chain of free bodies, each connected to the next by a virtual joint, and a state."""
    body = (
        '<body name="b{0}" pos="{0} 0.1 1" quat="0.8 0.1 0.5 0.2"><freejoint/>'
        '<geom type="box" size="0.1 0.2 0.3" contype="0"/></body>'
    )
    xml = models.MJCF.format("".join(body.format(i) for i in range(len(joints) + 1)))
    links = [
        svkc.VirtualLink(
            f"j{i}", f"b{i}", f"b{i + 1}", joint, pos=(0.3, 0, 0), axis=(0.2, 0.3, 1),
            connected=True,
        )
        for i, joint in enumerate(joints)
    ]  # fmt: skip
    chain = svkc.load(xml, virtual_links=links, spare=spare)
    rng = np.random.default_rng(3)
    change = np.zeros(chain.dofs)
    change[chain.nv :] = 0.3 * rng.normal(size=chain.dofs - chain.nv)
    q = svkc.integrate(chain, chain.q_load, jnp.asarray(change))
    return chain, chain.state(q, rng.normal(size=chain.nv))


@pytest.fixture(scope="module")
def every_joint():
    return chain_of_joints(list(ROWS))


@pytest.mark.slow
def test_number_of_rows(every_joint):
    assert delassus_rows(every_joint[0], has_lock_mask=False).count == sum(ROWS.values())
    # if coordinates may be locked, a row along a joint's axis may become a constraint
    locked = delassus_rows(every_joint[0], has_lock_mask=True)
    assert locked.count == 6 * len(ROWS)
    assert list(locked.projected_links) == [i for i, joint in enumerate(ROWS) if joint != "weld"]
    spare = delassus_rows(chain_of_joints(["hinge"], spare=1)[0], has_lock_mask=False)
    assert spare.count == 5 + 6


@pytest.mark.slow
def test_selected_rows_are_those_that_no_joint_can_follow(every_joint):
    """N is orthonormal, and N J is zero along joints, except those that are projected out."""
    chain, state = every_joint
    loops = loop_kinematics(chain, state.structure, state.q)
    rows = constraint_rows(chain, state.structure, loops)
    select = rows.in_D.select(jnp.eye(6 * len(ROWS)), rows.frame_axes)
    np.testing.assert_allclose(select @ select.T, np.eye(rows.in_D.count), atol=ROUND_OFF)
    force = jnp.linspace(-1.0, 2.0, rows.in_D.count)
    np.testing.assert_allclose(
        rows.in_D.expand(force, rows.frame_axes), select.T @ force, atol=ROUND_OFF
    )
    along_joints = select @ loops.J[:, chain.nv :]
    of_other_links = slice(6 * len(rows.in_D.projected_links), None)
    np.testing.assert_allclose(along_joints[of_other_links], 0, atol=ROUND_OFF)
    assert float(jnp.abs(rows.reject(along_joints.T)).max()) < ROUND_OFF
    # of each link as many rows are used as it has in D
    used = np.abs(np.asarray(select)).reshape(-1, len(ROWS), 6).sum(-1) > 0
    assert list(used.sum(0)) == list(ROWS.values())


@pytest.mark.slow
@pytest.mark.parametrize("locks", [False, True])
def test_accelerations_are_those_of_composite_bodies(every_joint, locks):
    """Torques act on virtual joints, too. With a lock in the tree every link has six rows."""
    chain, state = every_joint
    if locks:
        state = svkc.lock(chain, state, chain.joint_names[0])
    tau = jnp.linspace(-3.0, 2.0, chain.dofs)
    reference, bodies = (
        jax.jit(lambda m=m: acceleration(chain, state.structure, state.q, state.v, tau, m))()
        for m in (svkc.dynamics.CompositeBodies(), svkc.dynamics.ArticulatedBodies())
    )
    assert np.abs(bodies - reference).max() < REFERENCE * np.abs(reference).max()


def tilted_mechanism(joint: str, legs: int):
    """Return a plate on legs of two bars each, in a plane that is oblique to the world's axes.

    Each leg but the first is connected to the plate by a virtual joint. The rows of each loop that
    describe motions out of the plane are redundant.
    """
    bar = (
        '<body name="{0}" pos="{1}"><joint axis="0 1 0"/>'
        '<geom type="capsule" size="0.02" fromto="0 0 0 {2}" contype="0"/>{3}</body>'
    )

    def leg(i, child=""):
        high = bar.format(f"high{i}", "0.1 0 0.5", "-0.1 0 0.6", child)
        return bar.format(f"low{i}", f"{0.4 * i} 0 0", "0.1 0 0.5", high)

    plate = bar.format("plate", "-0.1 0 0.6", f"{0.4 * legs} 0 0.1", "")
    links = [
        svkc.VirtualLink(
            f"loop{i}", "plate", f"high{i}", joint, pos=(0.4 * i, 0, 0),
            axis=(0, 1, 0) if joint == "hinge" else (1, 0, 0.3), connected=True,
        )
        for i in range(1, legs)
    ]  # fmt: skip
    tree = "".join(leg(i, plate if i == 0 else "") for i in range(legs))
    tilted = f'<body name="base" quat="0.7 0.3 -0.2 0.5">{tree}</body>'
    return svkc.load(models.MJCF.format(tilted), virtual_links=links)


@pytest.mark.slow
@pytest.mark.parametrize("legs", [3, 5, 6])
@pytest.mark.parametrize("joint", ["hinge", "slide", "weld"])
def test_redundant_rows_in_an_oblique_plane(joint, legs):
    """No `RowChoice` is given, so that all rows are used. Delassus' matrix has many tiny pivots."""
    chain = tilted_mechanism(joint, legs)
    state = chain.state(v=np.linspace(-1.0, 1.0, chain.nv))
    tau = jnp.linspace(-3.0, 2.0, chain.dofs)
    reference, bodies = (
        jax.jit(lambda m=m: acceleration(chain, state.structure, state.q, state.v, tau, m))()
        for m in (svkc.dynamics.CompositeBodies(), svkc.dynamics.ArticulatedBodies())
    )
    assert np.abs(bodies - reference).max() < REFERENCE * np.abs(reference).max()
    if legs == 3:
        dt = 1e-3
        by_step = (svkc.step(chain, state, tau, dt).v - state.v) / dt
        assert np.abs(by_step - reference).max() < REFERENCE * np.abs(reference).max()
